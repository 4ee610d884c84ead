"""Help: the page of `--help`, and sentences for usage errors."""
