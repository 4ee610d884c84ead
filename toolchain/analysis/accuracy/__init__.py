"""Measurement of the accuracy of a machine's posteriors on readings."""
