"""The processes: subscriber, publisher, pcie-app, master, board, loader and hub, and what they share."""
