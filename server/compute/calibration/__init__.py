"""Calibrations as a service makes them: expected, guided, fitted from images."""
