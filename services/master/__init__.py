"""A run of the master: its peers, and the flow of frames between them."""
