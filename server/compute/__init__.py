"""Computations of the worker process and of the command line; independent of service and HTTP."""
