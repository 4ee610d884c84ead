"""Local sockets of the processes, and the records that cross them."""
