"""Local sockets of the processes, and the records on them."""
