"""A real robot among landmarks: range and bearing from the UTIAS MR.CLAM data set."""
