"""Tiles of a step's points, fitted by workers that share its folder."""
