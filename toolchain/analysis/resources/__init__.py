"""Estimates of the FPGA resources and the energy of a machine."""
