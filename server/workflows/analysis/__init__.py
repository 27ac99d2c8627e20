"""Analyses: begun, measured, read in a frame, and what is to be told of them."""
