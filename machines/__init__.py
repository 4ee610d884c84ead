"""Bayesian machines, emulated to the bit: pure computing, no sockets, no files.

Start at `machines.posterior` (one call, for a notebook) or `machines.kernel` (a board's machine).
`machines.bm1` says what a machine is, `machines.reference` what it does, cycle by cycle, and
`machines.fast` does the same quickly. The modules without a kernel (`parameters`, `bm1`, `encode`,
`posterior`) never load numba.
"""
