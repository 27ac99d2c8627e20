"""Expected uncertainty of a planned rig, calibration and measurement, before anything is bought or moved."""
