"""The measurement: arrays and frozen options in, frozen results out."""
