"""Files in and out: images, calibrations, results. Stands on `core` alone."""
