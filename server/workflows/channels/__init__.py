"""Channels of a test: read during the captures, or imported from a load frame's record."""
