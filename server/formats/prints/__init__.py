"""Targets and speckle as vector drawings in true millimetres."""
