"""The boards as the services see them: emulated ones as processes, those of a deployment, frames and results."""
