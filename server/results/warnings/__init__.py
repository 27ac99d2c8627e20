"""Warnings to know before a result is used: one list for the API, the page and the report."""
