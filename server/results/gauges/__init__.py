"""Extensometers, lines, areas and rigid motions over result files."""

FRAME_HELP = "axes of positions, displacements and strain: system, specimen, or JSON as of a gauge's align (system)"
