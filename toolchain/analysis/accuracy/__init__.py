"""Exact and statistical measurement of a machine's posteriors on readings."""
