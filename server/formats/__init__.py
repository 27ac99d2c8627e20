"""Files in and out: images, calibrations, results. Imports `core` alone."""
