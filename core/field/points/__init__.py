"""One point and many: start values, fits, prepared images, and the field that they become."""
