"""Fixtures that several test files share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def _missing(what: str) -> None:
    """Fail in CI, where nothing may be missing; elsewhere skip and say what to do."""
    if os.environ.get("CI", "").lower() == "true":
        pytest.fail(f"CI needs {what}")
    pytest.skip(f"{what} not found: put it there to run this test")


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder `shared` that lies beside the checkout, or the one STEREORIG_SHARED names."""
    candidates = [ROOT.parent / "shared", ROOT.parent.parent / "shared"]
    if "STEREORIG_SHARED" in os.environ:
        candidates.insert(0, Path(os.environ["STEREORIG_SHARED"]))
    for folder in candidates:
        if folder.is_dir():
            return folder
    _missing("the folder ../shared")
    raise AssertionError


@pytest.fixture(scope="session")
def specimen_dir(shared_dir: Path) -> Path:
    """Real images of the D-shaped tension specimen, with their calibration."""
    folder = shared_dir / "data" / "d_specimen"
    if not (folder / "calibration_dice.xml").is_file():
        _missing(f"{folder}")
    return folder
