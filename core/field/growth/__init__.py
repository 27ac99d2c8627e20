"""Growth of a field from its seeds over the region."""
