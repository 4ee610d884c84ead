"""What the processes tell each other, and the local sockets over which they do."""
