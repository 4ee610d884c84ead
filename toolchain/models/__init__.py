"""Models: what is searched, what is known given it, and the exact posterior (thesis 2.1.2, 3.4)."""
