"""The region: the grid of points, cuts, visibility, neighbours."""
