"""Evaluations: numbers and verdicts worked out from the steps of an analysis."""
