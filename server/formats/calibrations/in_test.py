"""The calibrations in a test's folder: the one that it was made with, and those that it was given since.

The first is ``calibration.json`` and stays there; each later one is ``calibrations/<sha256>.json``. Nothing
is ever replaced, so that an analysis keeps the one that it was measured with. ``test.json`` names the one in force.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from stereorig.server.formats.manifest import checked_bytes, is_there

#: folder of the later ones
LATER = "calibrations"


def later_file(test: Path, sha256: str) -> Path:
    """Path of a calibration that a test was given after it was made, by its SHA-256."""
    return test / LATER / f"{sha256}.json"


def calibration_in(test: Path, sha256: str | None = None) -> Path:
    """Path of a calibration in a test's folder, whether it is there or not.

    Parameters
    ----------
    test
        The test's folder.
    sha256
        Checksum of the calibration; None: the calibration in force, whose checksum ``test.json`` has.

    Raises
    ------
    DamagedError
        ``file_missing`` if it was there and is gone.
    """
    wanted = _in_force(test) if sha256 is None else sha256
    later = None if wanted is None else later_file(test, wanted)
    return later if later is not None and is_there(later) else test / "calibration.json"


def calibration_id_in(test: Mapping[str, object], sha256: str | None) -> str | None:
    """Return the id of the calibration that a test or one of its analyses was given; None if it is not known.

    Parameters
    ----------
    test
        ``test.json``.
    sha256
        Checksum of the calibration; None: the one in force.
    """
    current = test.get("calibration_id")
    given = test.get("calibrations")
    if sha256 is not None and isinstance(given, Mapping) and sha256 in given:
        current = given[sha256]
    elif sha256 is not None and test.get("calibration_sha256") not in (None, sha256):
        current = None
    return None if current is None else str(current)


def measured_with(analysis: Path) -> str | None:
    """Return the SHA-256 of the calibration of an analysis' folder, as its own documents have it."""
    inputs = _document(analysis / "analysis.json").get("inputs")
    if isinstance(inputs, dict) and isinstance(inputs.get("calibration_sha256"), str):
        return str(inputs["calibration_sha256"])
    used = _document(analysis / "summary.json").get("calibration")
    found = used.get("sha256") if isinstance(used, dict) else None
    return found if isinstance(found, str) else None


def _in_force(test: Path) -> str | None:
    found = _document(test / "test.json").get("calibration_sha256")
    return found if isinstance(found, str) and found.isalnum() else None


def _document(path: Path) -> dict[str, object]:
    try:
        found = json.loads(checked_bytes(path))
    except (OSError, ValueError):
        return {}  # a folder put together by hand has none
    return found if isinstance(found, dict) else {}
