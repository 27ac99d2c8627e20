"""What a planned rig, calibration and measurement will leave uncertain, before anything is bought or moved."""
