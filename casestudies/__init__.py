"""Case studies: a model, a simulator or a data reader, and a page of words each."""
