"""The VHDL of a board: its files for one image, the tools that read it, and compiled simulations."""
