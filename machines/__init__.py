"""Bayesian machines, emulated to the bit: pure computing, no sockets, no files.

Start at `machines.posterior` (one call, for a notebook) or `machines.kernel` (a board's machine).
`machines.bm1` defines a machine, `machines.reference` runs it cycle by cycle, and `machines.fast` does the
same quickly. Only `machines.fast` loads numba.
"""
