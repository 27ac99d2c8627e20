"""Subcommands for a test that is planned: what to expect of it, and what to print for it."""
