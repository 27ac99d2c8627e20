"""Readings of gauges, and the files that hold them."""
