"""The full field: region, seeds, growth, validity checks."""
