"""Verification certificates."""
