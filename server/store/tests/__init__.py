"""Tests on disk, their steps and their analyses."""
