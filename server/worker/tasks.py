"""What the compute worker can be asked to do: plain values in, plain values out.

The functions import the numerical modules when they are called, so that only the worker's process loads the kernels.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class EarlierStep:
    """Images of a step that was measured.

    Parameters
    ----------
    images
        Paths of camera 1's and camera 2's.
    sha256
        Of their files, as recorded.
    """

    images: tuple[str, str]
    sha256: tuple[str, str]


@dataclass(frozen=True)
class StepTask:
    """One step of one analysis; plain paths and values, so that any executor can carry it.

    Parameters
    ----------
    folder
        The analysis' folder; the result goes there as ``step_<nnnn>.nc``.
    calibration
        Path of the test's calibration.
    kind
        ``shape`` of the pair ``ref1``, ``ref2``, or ``motion`` from it to ``cur1``, ``cur2``.
    n
        Number of the step that is measured.
    reference
        Number of the reference step, whose shape is measured first.
    images
        Paths ``ref1``, ``ref2``, ``cur1``, ``cur2``.
    previous
        Number of the step measured before, whose field gives start values.
    settings
        Region, subset and models, as in ``analysis.json``.
    inputs
        Name and SHA-256 of each input file.
    following
        Paths of the images of the step that will probably be asked for next, to be read meanwhile.
    noise
        Path of the noise models, or None.
    averages
        By an image's path: how many frames it is the mean of, and what its grey levels were multiplied by.
    earlier
        By number, the steps between the reference and this one that were measured: this one may be matched against
        them.
    keeps_starts
        Whether later steps start from what this one finds.
    """

    folder: str
    calibration: str
    kind: Literal["shape", "motion"]
    n: int
    reference: int
    images: dict[str, str]
    previous: int | None
    settings: dict[str, Any]
    inputs: dict[str, str]
    label: str
    load_n: float | None
    following: tuple[str, str] | None = None
    noise: str | None = None
    averages: dict[str, tuple[int, float]] = field(default_factory=dict)
    earlier: dict[int, EarlierStep] = field(default_factory=dict)
    keeps_starts: bool = True


@dataclass(frozen=True)
class NoiseTask:
    """The fit of both cameras' noise models.

    Parameters
    ----------
    folder
        The noise measurement's folder, with its frames; ``noise.json`` goes there.
    """

    folder: str


@dataclass(frozen=True)
class FitTask:
    """The fit of one calibration.

    Parameters
    ----------
    folder
        The calibration's folder, with its views; ``calibration.json`` goes there.
    plan
        Content of ``plan.json``.
    views
        Content of ``view.json``.
    """

    folder: str
    plan: dict[str, Any]
    views: list[dict[str, Any]]


def warm_up(threads: int) -> None:
    """Load and compile every kernel once, before the first task needs them."""
    _heavy("server.compute.measurement").warm_up(threads)


def measure_step(task: StepTask) -> dict[str, Any]:
    """Measure one step; its result file is readable when this returns. Returns the step's summary."""
    summary: dict[str, Any] = _heavy("server.compute.measurement").measure_step(task)
    return summary


def fit_calibration(task: FitTask) -> dict[str, Any]:
    """Find the grid in every view and fit both cameras; ``calibration.json`` is there when this returns."""
    summary: dict[str, Any] = _heavy("server.compute.calibration_fit").fit_calibration(task)
    return summary


def fit_noise(task: NoiseTask) -> dict[str, Any]:
    """Fit both cameras' noise models; ``noise.json`` is there when this returns."""
    summary: dict[str, Any] = _heavy("server.compute.noise_fit").fit_noise(task)
    return summary


def _heavy(module: str) -> Any:
    return importlib.import_module(module)
