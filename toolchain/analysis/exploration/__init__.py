"""Sweeps over the possible machines of a model, and the thesis's claims as experiments."""
