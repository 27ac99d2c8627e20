"""A test in one file, with all that is needed to measure it again elsewhere."""
