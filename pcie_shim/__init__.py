"""Boards: registers, link, emulated board, driver, programming files (thesis 2.3, 3.2)."""
