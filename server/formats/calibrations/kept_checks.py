"""Checks made of a calibration after it was made: ``calibration.checks.json`` in the folder of ``calibration.json``.

The calibration itself stays as it was written, with its checksum; the file of checks names the checksum that its
findings hold for. If another calibration has replaced it, the findings are not shown.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.manifest import checked_bytes

KEPT_CHECKS = "calibration.checks.json"


def checks_file(calibration: Path) -> Path:
    """Return the path of the checks kept with a calibration's file."""
    return calibration.with_name(f"{calibration.stem}.checks.json")


def read_checks(calibration: Path, sha256: str) -> dict[str, dict[str, Any]]:
    """Return the findings kept for a calibration by the checks' names; empty without any, or of another calibration."""
    try:
        content = json.loads(checked_bytes(checks_file(calibration)))
    except (OSError, ValueError):
        return {}
    if not isinstance(content, dict) or content.get("calibration_sha256") != sha256:
        return {}
    found = content.get("checks")
    if not isinstance(found, dict):
        return {}
    return {name: finding for name, finding in found.items() if isinstance(finding, dict)}


def keep_check(
    calibration: Path,
    sha256: str,
    name: str,
    finding: Mapping[str, object],
    *,
    write: Callable[[Path, bytes], object] = write_bytes,
) -> Path:
    """Keep a check's finding with a calibration, by ``write``; a later one of the same name replaces it.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``.
    """
    checks = {**read_checks(calibration, sha256), name: dict(finding)}
    content = {"calibration_sha256": sha256, "checks": checks}
    path = checks_file(calibration)
    write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return path


def with_checks(content: Mapping[str, Any], kept: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return a calibration.json's content with the later checks, which also replace entries in ``checks.made``."""
    if not kept:
        return dict(content)
    out = {**content, "kept_checks": dict(kept)}
    checks = content.get("checks")
    if isinstance(checks, Mapping) and isinstance(checks.get("made"), list):
        made = [
            {**entry, **_made(kept[entry["name"]])}
            if isinstance(entry, Mapping) and entry.get("name") in kept
            else entry
            for entry in checks["made"]
        ]
        out["checks"] = {**checks, "made": made}
    return out


def _made(finding: Mapping[str, Any]) -> dict[str, Any]:
    return {"made": True, "agrees": finding.get("agrees"), "text": finding.get("text")}
