"""Predictions for machines before they are built: accuracy, cycles, resources, energy, and sweeps."""
