"""Case studies, each with a model, a simulator or a data reader, and a page that describes it."""
