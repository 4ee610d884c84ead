"""The board side of the link: the emulated board and the server that puts it behind a socket."""
