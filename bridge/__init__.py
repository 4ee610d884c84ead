"""The rosbridge protocol without ROS: asyncio client, embedded server, and field lookup in messages.

Clients start at `connect` in `bridge.client`, for topics, services and actions. `serve_hub` in `bridge.hub.server` runs
a server for programs and tests. `bridge.errors` contains the errors of connections and messages.
"""
