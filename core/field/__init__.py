"""The full field: region, seeds, growth, gates."""
