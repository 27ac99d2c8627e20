"""Compiled code of the dense field; :mod:`core.dense.windows` is the narrow function before it."""
