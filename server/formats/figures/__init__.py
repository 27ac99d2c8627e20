"""Fields as pictures: colours, the map between its points, axes and scale, the figure around it."""
