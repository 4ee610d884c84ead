"""The dashboard, a page in the browser. It gets its data from public topics and status sockets."""
