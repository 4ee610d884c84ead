"""Inspection of a deployment: machine, loss, accuracy, resources and energy."""
