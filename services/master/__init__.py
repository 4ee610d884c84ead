"""A run of the master: its peers, the flow of frames between them, and reloads of the deployment."""
