"""Subcommands that measure, read and write files; no service."""
