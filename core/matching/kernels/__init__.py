"""Compiled code of the matching; :mod:`core.matching.fit` is the narrow function before it."""
