"""Conditions under which the catalogue's index is believed, and its rebuilding while the service runs."""
