"""Measuring an analysis again from what is stored, and comparing."""
