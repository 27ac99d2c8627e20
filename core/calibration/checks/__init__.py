"""Checks of a calibration that do not rest on its own fit."""
