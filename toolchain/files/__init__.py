"""Bounded reading of the files that users name."""
