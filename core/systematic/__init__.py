"""Systematic terms that no standard uncertainty holds, estimated for each field from itself, to be stated beside it.

Interpolation of sharp texture, the order of patches on what bends, the width of the strain's window.
"""
