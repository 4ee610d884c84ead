"""The rosbridge protocol without ROS: an asyncio client, an embedded server, and access to fields of messages.

`connect` in `bridge.client` connects to a server, for topics, services and actions. `serve_hub` in
`bridge.hub.server` runs a server for programs and tests. `bridge.errors` contains the errors of connections and
messages.
"""
