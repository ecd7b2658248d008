"""A data set of recorded drives: collected, stored, read."""
