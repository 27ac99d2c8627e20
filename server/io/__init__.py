"""Files in and out: images, calibrations, results."""
