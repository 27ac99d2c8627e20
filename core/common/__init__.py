"""What all points of a result share of its uncertainty: the calibration's part, carried to any quantity."""
