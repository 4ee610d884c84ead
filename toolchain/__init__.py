"""From a model in Python to everything a Bayesian machine needs (thesis 3.4)."""
