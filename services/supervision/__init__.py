"""Supervision of processes: starting, monitoring and stopping them together."""
