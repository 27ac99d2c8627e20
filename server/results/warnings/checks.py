"""Everything that must be known before an analysis' results are used, found in its folder and its test's."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.names import CAMERAS
from stereorig.server.documents.tests import AnalysisRecord
from stereorig.server.formats.calibrations.in_test import (
    LATER,
    calibration_id_in,
    calibration_in,
    later_file,
    measured_with,
)
from stereorig.server.formats.files import mark_of
from stereorig.server.formats.manifest import DamagedError
from stereorig.server.results.staleness import stale_inputs
from stereorig.server.results.warnings.analysis import ResultWarning, analysis_warnings
from stereorig.server.store.durable import known_json, read_record


@dataclass(frozen=True)
class Checks:
    """Findings about an analysis.

    Attributes
    ----------
    stale
        Inputs that are gone or were replaced since.
    warnings
        Failed checks first.
    """

    stale: tuple[str, ...]
    warnings: tuple[ResultWarning, ...]

    def plain_warnings(self) -> list[dict[str, object]]:
        """Return the warnings as plain values."""
        return [one.plain() for one in self.warnings]


def checks_of(folder: Path, failed: Mapping[str, object] | None = None) -> Checks:
    """Return the findings about the analysis in a folder of its test's.

    Parameters
    ----------
    folder
        ``<test>/analyses/<analysis>``.
    failed
        Steps that could not be measured, where more is known than ``summary.json`` has.

    Raises
    ------
    FileFormatError
        ``analysis.json`` cannot be read.
    """
    stale = stale_reasons(folder.parent.parent, read_record(AnalysisRecord, folder / "analysis.json"))
    return Checks(tuple(stale), tuple(analysis_warnings(folder, stale=stale, failed=failed)))


def checks_if_changed(
    folder: Path, failed: Mapping[str, object] | None, before: bytes | None
) -> tuple[bytes, Checks | None]:
    """Return the state of the checked files, and the findings; None for these if it is the same as ``before``.

    Parameters
    ----------
    folder, failed
        As in :func:`checks_of`.
        State at the last call.
        State at which the same was asked for.
    """
    state = state_of(folder)
    return state, None if state == before else checks_of(folder, failed)


def state_of(folder: Path) -> bytes:
    """Return a digest that differs whenever a file differs that :func:`checks_of` looks at.

    It is made of the files' sizes, and of times that no program can set; the steps' files are not read, of which there
    may be thousands in each of a hundred analyses.
    """
    test = folder.parent.parent
    calibration_id = calibration_id_in(known_json(test / "test.json"), measured_with(folder)) or ""
    reviewed = test.parent.parent / "calibrations" / Path(calibration_id).name
    digest = hashlib.blake2b(digest_size=16)
    for path in (folder, test, test / LATER, reviewed):
        for line in _stated(sorted(_entries_of(path))):
            digest.update(line)
    of_a_step = ("step.json", *(f"{cam}.tif" for cam in CAMERAS))
    for step in sorted(_entries_of(test / "steps")):
        for line in _stated(f"{step}/{name}" for name in of_a_step):
            digest.update(line)
    return digest.digest()


def _entries_of(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return [entry.path for entry in entries]
    except OSError:
        return []


def _stated(paths: Iterable[str]) -> Iterator[bytes]:
    """Yield a line for each file, and for each path that is not there; none for a folder."""
    for path in paths:
        try:
            found = os.stat(path)  # noqa: PTH116 - ten thousands of them
        except OSError:
            yield f"{path}\n".encode(errors="surrogateescape")
            continue
        if not stat.S_ISDIR(found.st_mode):
            yield f"{path} {mark_of(found)}\n".encode(errors="surrogateescape")


def stale_reasons(test: Path, document: AnalysisRecord) -> list[str]:
    """Return the inputs that are gone or were replaced since an analysis was made; see :func:`stale_inputs`."""
    inputs = document.inputs
    try:
        calibration = calibration_in(test, inputs.calibration_sha256)
    except DamagedError:  # test.json is unreadable, so that the calibration in force is not known
        calibration = later_file(test, str(inputs.calibration_sha256))
    return stale_inputs(
        test,
        {int(n): hashes for n, hashes in inputs.steps.items()},
        calibration=calibration,
        calibration_sha256=inputs.calibration_sha256,
        reference=document.steps[0],
    )
