"""Pipe mode of subscriber, pcie-app and publisher: without a master, one JSON value a line from and to standard streams."""
