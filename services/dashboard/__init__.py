"""The page in the browser: it reads topics and status sockets as anybody may, and no service imports it."""
