"""Staleness of results: their inputs are gone or were replaced since.

A result file holds the SHA-256 of everything it was made from. Files that have not been touched since their step was
committed are not read again.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.in_test import LATER, calibration_in
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.manifest import DamagedError
from stereorig.server.formats.results.folder import number_of, results_in
from stereorig.server.formats.results.reading import ResultHead
from stereorig.server.store.durable import UnchangedFiles, known_json

#: checksums of steps, which are asked for again and again while an analysis runs
_RECORDED = UnchangedFiles(2_000)


def stale_inputs(
    test: Path,
    steps: Mapping[int, Mapping[str, str | None]],
    *,
    calibration: Path | None,
    calibration_sha256: str | None,
    reference: int,
) -> list[str]:
    """Return the inputs of an analysis that are gone from a test's folder or differ in it; empty: it is up to date.

    Parameters
    ----------
    test
        The test's folder, with ``steps/<nnnn>/``.
    steps
        By step, by camera, the checksums that the analysis was made with.
    calibration, calibration_sha256
        The calibration's file, None if it is not known, and its checksum.
    reference
        The reference step's number.
    """
    found = []
    if calibration is not None and calibration_sha256 is not None:
        found += _changed(calibration, calibration_sha256, f"{calibration.name}")
    for n, hashes in sorted(steps.items()):
        input_name = f"the reference, step {n}," if n == reference else f"step {n}"
        folder = test / "steps" / f"{n:04d}"
        mark = folder / "step.json"
        committed = _file_stat(mark)
        if committed is None:
            found.append(f"{input_name} is gone")
            continue
        recorded = _RECORDED.made_of(mark, _recorded)
        for cam in CAMERAS:
            image = folder / f"{cam}.tif"
            if recorded is not None and cam in recorded and recorded[cam] != hashes.get(cam):
                found.append(f"{cam} of {input_name} was replaced")
            elif recorded is None or (now := _file_stat(image)) is None or now.st_ctime_ns > committed.st_ctime_ns:
                # the inode changed after the step was committed; no program can set that time
                found += _changed(image, hashes.get(cam), f"{cam} of {input_name}")
    return found


def stale_results(files: Sequence[Path], heads: Sequence[ResultHead], folder: Path | None = None) -> list[str]:
    """Return the inputs that are gone or were replaced since result files were written.

    Parameters
    ----------
    files
        Result files of one measurement.
    heads
        Attributes of each.
    folder
        The measurement's folder, if the files are not in it.
    """
    folder = files[0].absolute().parent if folder is None else folder.absolute()
    summary = known_json(folder / "summary.json", {"steps": _number})
    test = folder.parent.parent if (folder.parent.parent / "steps").is_dir() else None
    steps = {head.step: _images(head.inputs_sha256) for head in heads}
    reference = heads[-1].reference_step or 0
    steps.setdefault(reference, {cam: heads[-1].inputs_sha256.get(f"reference_{cam}") for cam in CAMERAS})
    calibration = None
    sha256 = heads[0].inputs_sha256.get("calibration")
    if test is not None and folder.parent.name == "analyses":
        calibration = calibration_in(test, sha256)
    elif isinstance(summary.get("calibration"), dict):
        calibration = Path(str(summary["calibration"].get("file")))
        own = {test.name, LATER} if test is not None else set()
        if test is not None and calibration.suffix == ".json" and calibration.parent.name in own:
            calibration = calibration_in(
                test, sha256
            )  # independent of the folder that the measurement was started from
        elif not calibration.is_absolute() and not calibration.is_file():
            calibration = None
    found = _missing_results(folder, summary)
    if test is not None:
        return found + stale_inputs(
            test, steps, calibration=calibration, calibration_sha256=sha256, reference=reference
        )
    if calibration is not None and calibration.is_file():  # one that was moved away may be unchanged
        found += _changed(calibration, sha256, calibration.name)
    for head in heads:
        for cam in CAMERAS:
            image = Path(head.image_file(cam))
            if image.is_file():
                found += _changed(image, head.inputs_sha256.get(cam), f"{cam} of step {head.step}")
    return found


def _missing_results(folder: Path, summary: dict[str, Any]) -> list[str]:
    """Results that the measurement's own record names and that are not there."""
    there = set(map(number_of, results_in(folder)))
    listed = summary.get("steps") or []
    return [f"the result of step {n} is gone" for n in listed if isinstance(n, int) and n not in there]


def _number(step: object) -> object:
    return step.get("n") if isinstance(step, dict) else None


def _images(inputs: Mapping[str, str]) -> dict[str, str | None]:
    """Return the checksums of the step's own images."""
    return {cam: inputs.get(cam) for cam in CAMERAS}


def _changed(path: Path, sha256: str | None, input_name: str) -> list[str]:
    if not path.is_file():
        return [f"{input_name} is gone"]
    return [] if sha256 is None or sha256_of(path) == sha256 else [f"{input_name} was replaced"]


def _file_stat(path: Path) -> os.stat_result | None:
    """Return the result of ``stat`` for a regular file; None if there is none."""
    try:
        found = os.stat(path)  # noqa: PTH116 - three of each of some thousand steps
    except OSError:
        return None
    return found if stat.S_ISREG(found.st_mode) else None


def _recorded(mark: Path) -> dict[str, object] | None:
    try:
        found = known_json(mark).get("sha256")
    except DamagedError:
        return None
    return found if isinstance(found, dict) else None
