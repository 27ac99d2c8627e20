"""Uncertainty that all points of a result share: the calibration's part, propagated to any quantity."""
