"""Binocular disparity with many small BM1 on one board. Each BM1 has the matching costs of one pixel (thesis 4.4)."""
