"""The region: the grid of points, cuts, what a point can see, its neighbours."""
