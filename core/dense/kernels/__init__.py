"""Compiled code of the dense field; :mod:`stereorig.core.dense.windows` is the narrow function before it."""
