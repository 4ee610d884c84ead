"""Boards with their registers, link, driver, programming files and emulation (thesis 2.3, 3.2)."""
