"""Calibrations of other programs: a reader a format, and what all of them must hold."""
