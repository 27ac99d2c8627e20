"""A report that a laboratory can file: one HTML file, from a data folder or from result files alone."""
