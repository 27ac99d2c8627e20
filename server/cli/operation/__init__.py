"""Subcommands that run, check and tidy a service and its devices."""
