"""The processes of a run: subscriber, publisher, pcie-app, master, board, loader and hub."""
