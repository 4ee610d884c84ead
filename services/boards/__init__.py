"""Boards as the services use them: processes of emulated boards, and the frames that a deployment's boards compute."""
