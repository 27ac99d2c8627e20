"""Compiled code of the matching; :mod:`stereorig.core.matching.fit` is its typed interface."""
