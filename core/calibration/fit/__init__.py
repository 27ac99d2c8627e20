"""The least-squares fit: predicted positions and derivatives, start values, one camera, both together."""
