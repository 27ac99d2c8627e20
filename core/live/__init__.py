"""A measurement that runs while the test does: frames in order, gauges read in each, and channels' clocks."""
