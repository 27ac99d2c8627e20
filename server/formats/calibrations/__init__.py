"""Calibration files: this program's own format and the formats of other programs."""
