"""Decoders of image files that refuse each file with missing or surplus parts, and judge sizes before they decode."""
