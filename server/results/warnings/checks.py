"""Everything that must be known before an analysis' results are used, found in its folder and its test's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from server.formats.calibrations.in_test import calibration_in
from server.results.staleness import stale_inputs
from server.results.warnings.analysis import ResultWarning, analysis_warnings
from server.store.documents import AnalysisRecord
from server.store.durable import read_record


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


def stale_reasons(test: Path, document: AnalysisRecord) -> list[str]:
    """Return what is gone or was replaced since an analysis was made; see :func:`stale_inputs`."""
    inputs = document.inputs
    return stale_inputs(
        test,
        {int(n): hashes for n, hashes in inputs.steps.items()},
        calibration=calibration_in(test, inputs.calibration_sha256),
        calibration_sha256=inputs.calibration_sha256,
        reference=document.steps[0],
    )
