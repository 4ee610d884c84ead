"""A real robot among landmarks, with ranges and bearings from the UTIAS MR.CLAM data set."""
