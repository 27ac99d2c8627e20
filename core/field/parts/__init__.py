"""Parts of a subset, and the effect of each on its match."""
