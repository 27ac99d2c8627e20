"""The live measurement's side of the worker."""
