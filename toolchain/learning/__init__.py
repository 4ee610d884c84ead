"""Tables learnt from recorded readings with ground truth."""
