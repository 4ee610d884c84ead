"""Predictions for a machine before it is built: accuracy, cycles, resources, energy, and sweeps over many."""
