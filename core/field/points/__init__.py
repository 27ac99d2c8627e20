"""Points: start values, fits, prepared images, and the field assembled from them."""
