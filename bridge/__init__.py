"""rosbridge without ROS: protocol core, asyncio client, finding fields in messages, embedded server."""
