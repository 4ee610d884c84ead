"""Bayesian machines, emulated bit for bit, without sockets and files.

Start at `machines.posterior` (one call, for a notebook) or `machines.kernel` (the machine of a board).
`machines.bm1` defines a machine, `machines.reference` runs it cycle by cycle, and `machines.fast` gets the
same results faster. Only `machines.fast` imports numba.
"""
