"""Binocular disparity: many small BM1 on one board, each with the matching costs of one pixel (thesis 4.4)."""
