"""Transport of WebSocket messages."""
