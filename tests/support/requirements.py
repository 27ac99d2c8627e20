"""What tests find beside the checkout, and what they say where something is missing."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def missing(what: str) -> None:
    """Fail in CI, where nothing may be missing; elsewhere skip and say what to do."""
    if os.environ.get("CI", "").lower() == "true":
        pytest.fail(f"CI needs {what}")
    pytest.skip(f"{what} not found: put it there to run this test")
