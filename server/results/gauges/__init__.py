"""Extensometers, lines, areas and rigid motions over result files."""
