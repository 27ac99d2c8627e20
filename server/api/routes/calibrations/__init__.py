"""Routes: calibrations, exports, reviews, noise models."""
