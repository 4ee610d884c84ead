"""Local sockets between the master and its services, and the records that are sent over them."""
