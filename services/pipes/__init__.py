"""Pipe mode: subscriber, pcie-app and publisher exchange JSON lines on standard streams, without a master."""
