"""The stages from a model to a deployment: parameters, codes, partitions, images and files (thesis 3.2, 3.4)."""
