"""The board side of the link: the emulated board, and the server that makes it accessible over a socket."""
