"""Pipe mode of subscriber, pcie-app and publisher: JSON lines on standard streams, without a master."""
