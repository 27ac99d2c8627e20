"""Optics of the simulated cameras: lenses and the rays of image points."""
