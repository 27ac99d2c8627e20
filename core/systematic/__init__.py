"""Systematic errors that no standard uncertainty contains, estimated for each field from itself and stated separately.

They are: interpolation of sharp texture, the order of patches on bent surfaces and motions, the width of the strain's
window.
"""
