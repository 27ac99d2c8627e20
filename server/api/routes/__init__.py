"""Thin routes over the service, a folder a subject."""
