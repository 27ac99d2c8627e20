"""Measuring an analysis again from its stored inputs, and comparing the results."""
