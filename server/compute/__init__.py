"""Computations behind the process wall; also behind the command line. Knows no service and no HTTP."""
