"""Channels of other devices, read as lines of text."""
