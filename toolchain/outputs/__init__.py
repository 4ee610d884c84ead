"""Output files for an FPGA: memories, VHDL parameters and the Quartus project (thesis 3.2)."""
