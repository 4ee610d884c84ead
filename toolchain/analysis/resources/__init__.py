"""Estimates of the FPGA resources and the energy that a machine takes."""
