"""One run of the master: its connections to the services, and the flow of frames between them."""
