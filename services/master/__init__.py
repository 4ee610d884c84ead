"""One run of the master: its peers, the frames between them, and how it takes another deployment."""
