"""First points of a field, without start values from a user."""
