"""rosbridge without ROS: protocol core, asyncio client, field lookup in messages, embedded server.

Start at `bridge.client` (`connect`: topics, services and actions) or `bridge.hub.server` (`serve_hub`: a server for
programs and tests). `bridge.errors` contains the errors of connections and messages.
"""
