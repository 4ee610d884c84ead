"""The host side of the link: links to boards, the mini-cluster that drives them, and the loader."""
