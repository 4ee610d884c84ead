"""The stages of a build, from the parameters and codes of a model to the files of a deployment (thesis 3.2, 3.4)."""
