"""Common parts of the three experiments: the running service, the rig's truth, the folder for the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.server.demo.client import AnalysisHandle, Calibrated, ServiceClient
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.results.reading import read_field
from stereorig.sim.rig import SimRig


@dataclass(frozen=True)
class DemoCheck:
    """One figure with its truth and its limit.

    Attributes
    ----------
    name, unit
        Name of the figure, and the unit of ``found`` and ``true``.
    found, true
        The figure and the truth; ``true`` is None if the figure is itself an error or a count.
    error, limit
        The error, and its largest allowed value.
    error_unit
        Unit of these two, if it is not ``unit``.
    """

    name: str
    unit: str
    found: float
    true: float | None
    error: float
    limit: float
    error_unit: str = ""

    @property
    def passed(self) -> bool:
        """Return True if the error is within the limit; NaN never is."""
        return bool(abs(self.error) <= self.limit)


@dataclass
class Outcome:
    """Outcome of an experiment.

    Attributes
    ----------
    checks
        Figures with limits; the demo fails if one is missed.
    lines
        Text of the table, ready to print.
    pictures
        Files and their captions.
    data
        Further figures for ``report.json``.
    """

    checks: list[DemoCheck] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    pictures: dict[str, str] = field(default_factory=dict)
    data: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class DemoRun:
    """One demo run.

    Parameters
    ----------
    client
        Speaks with the service.
    rig
        The truth, read from the same rig file; used for comparing only.
    config
        The rig file.
    out
        Folder for pictures and results.
    note
        Prints a line.
    """

    client: ServiceClient
    rig: SimRig
    config: Path
    out: Path
    note: Callable[[str], None]

    def calibrate(self) -> Calibrated:
        """Calibrate before the grid; save the calibration's file."""
        self.client.set_scene("grid")
        made = self.client.calibrate()
        write_bytes(self.out / "calibration.json", self.client.call("GET", f"/calibrations/{made.id}/file").content)
        return made

    def fetch(self, analysis: AnalysisHandle, steps: Sequence[int], folder: str = "results") -> list[Field]:
        """Fetch the result files of an analysis over HTTP, keep them, and read them."""
        make_folder(self.out / folder)
        fields = []
        for step in steps:
            path = self.out / folder / f"step_{step:04d}.nc"
            write_bytes(path, self.client.export(analysis, step))
            fields.append(read_field(path))
        return fields

    def reference_image(self, test_id: str, step: int = 0) -> NDArray[Any]:
        """Fetch camera 1's image of a step."""
        from stereorig.server.formats.images import decode_image

        data = self.client.call("GET", f"/tests/{test_id}/steps/{step}/cam1", params={"format": "tiff"}).content
        return decode_image(data, name=f"step {step} of {test_id}")


def pixels_of(result: Field) -> NDArray[np.float64]:
    """Return the points' positions (r, c, 2) in camera 1's reference image."""
    return np.stack([result.x_px, result.y_px], axis=-1)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format columns as lines of text, numbers to the right."""
    widths = [max(len(str(row[k])) for row in [head, *rows]) for k in range(len(head))]
    lines = ["  ".join(str(cell).rjust(w) for cell, w in zip(row, widths, strict=True)) for row in [head, *rows]]
    return [lines[0], "-" * len(lines[0]), *lines[1:]]
