"""Calibrations as the service makes them: planned, taken by a stage or by hand, repaired, decided on."""
