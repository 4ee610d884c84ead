"""Checks of models and deployments before anything runs."""
