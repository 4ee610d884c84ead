"""Bounded reading and atomic writing of files."""
