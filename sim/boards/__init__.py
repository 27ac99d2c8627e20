"""Calibration boards of the simulated world: their printed patterns, their poses and the maker's errors."""
