"""The stages from a model to a deployment: parameters, codes, each board's lines, images, files (thesis 3.2, 3.4)."""
