"""Calibrations of other programs: one reader a format, and the requirements on every one of them."""
