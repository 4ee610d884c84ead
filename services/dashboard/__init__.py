"""The page in the browser. It only reads public topics and status sockets; no service imports it."""
