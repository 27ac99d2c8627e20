"""Checks of a calibration that are independent of its own fit."""
