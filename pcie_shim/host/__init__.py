"""The host's side: links to boards, the driver of a mini-cluster of boards, and the loader."""
