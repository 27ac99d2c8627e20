"""Analyses: begun, measured, read in a frame, and the warnings about their results."""
