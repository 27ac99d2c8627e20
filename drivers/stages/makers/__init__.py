"""Controllers by maker and language: one driver each on the common parts of `stereorig.drivers.stages`."""
