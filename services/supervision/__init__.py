"""Processes of a run: started together, watched, and ended together, however the run ends."""
