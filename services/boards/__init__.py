"""Boards in the services: processes of emulated boards, the boards of a deployment, their frames and results."""
