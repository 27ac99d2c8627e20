"""Verification of a measuring system: errors against known motions and lengths, a verdict, and probable causes."""
