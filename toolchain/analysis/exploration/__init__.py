"""Sweeps over a model's possible machines, and the thesis's claims as experiments."""
