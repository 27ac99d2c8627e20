"""Cameras, lenses and the calibrated pair, Eqs. (1) to (8)."""
