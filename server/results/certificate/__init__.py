"""What a verification certificate is made from, as it is asked for."""
