"""Gauges on fields: rigid motion, alignment, extensometers, lines, areas; each with its uncertainty."""
