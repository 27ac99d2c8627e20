"""Comparison of a measured field with a model of the same surface."""
