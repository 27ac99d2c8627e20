"""Checks of measured points: validity, residuals, patch error, image edges, calibrated volume."""
