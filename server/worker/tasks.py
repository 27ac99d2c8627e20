"""Tasks of the compute worker: plain values in, plain values out.

The functions import the numerical modules when they are called, so that only the worker's process loads the kernels.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from core.names import CAMERAS
from core.settings import StoredSettings
from server.worker.shared_images import Placed

#: what crosses the process' border: numbers, texts, lists and objects of them
Plain = dict[str, Any]
#: what a step's field was measured as: the step after another one, or the head of a block
Earlier = Literal["step", "head"]


@dataclass(frozen=True, kw_only=True)
class StepImages:
    """One step's images, and what is known about them.

    Attributes
    ----------
    n
        Number of the step.
    files, sha256
        Of camera 1 and camera 2.
    averages
        How many frames each is the mean of, and what its grey levels were multiplied by.
    grey_from
        What the grey levels of camera 1 and camera 2 were made from, see :class:`server.formats.images.Decoded`.
    """

    n: int
    files: tuple[Path, Path]
    sha256: tuple[str, str]
    averages: tuple[int, float] = (1, 1.0)
    grey_from: tuple[str | None, str | None] = (None, None)


def grey_from_of(step: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """What the grey levels of both cameras' images of a step were made from, by its record."""
    known = step.get("grey_from")
    one, two = ((known if isinstance(known, dict) else {}).get(cam) for cam in CAMERAS)
    return one, two


def averages_of(step: Mapping[str, Any]) -> tuple[int, float]:
    """Number of frames that a step's images are means of, and the factor on their grey levels."""
    return int(step.get("frames") or 1), float(step.get("grey_scale") or 1.0)


@dataclass(frozen=True, kw_only=True)
class StepTask:
    """One step of one analysis; plain paths and values, so that any executor can carry it.

    Parameters
    ----------
    folder
        The analysis' folder; the result goes there as ``step_<nnnn>.nc``.
    calibration
        Path of the test's calibration.
    settings
        Of the analysis.
    reference
        The step whose shape is measured first.
    step
        The step to measure; the reference itself for its shape.
    previous
        Number of the step measured before, whose field gives start values.
    about
        Further text attributes of the result file.
    following
        The step that will probably be asked for next, to be read meanwhile.
    noise
        Path of the noise models, or None.
    earlier
        By number, the steps after the reference that this one may be matched against: later references, and the step
        before it.
    keeps_starts
        True if later steps start from what this one finds.
    against
        Reference that the step is matched against from seeds, without the steps between: the head of a block of steps
        that are measured side by side with others. Its field goes to ``head_<nnnn>.nc``, and there is no result.
    from_head
        True if the previous step's field is that of its head.
    compared
        What is there of the step already, its head or its result: the summary has under ``agrees`` whether steps that
        were measured from it stand. None: nothing.
    generation
        Larger once results have been replaced: what a process has kept of them is not theirs any more.
    shares
        True if other workers may be called to fit parts of it.
    """

    folder: Path
    calibration: Path
    settings: StoredSettings
    reference: StepImages
    step: StepImages
    previous: int | None
    about: dict[str, str] = field(default_factory=dict)
    following: StepImages | None = None
    noise: Path | None = None
    earlier: dict[int, StepImages] = field(default_factory=dict)
    keeps_starts: bool = True
    against: int | None = None
    from_head: bool = False
    compared: Earlier | None = None
    generation: int = 0
    shares: bool = False

    def files(self) -> list[Path]:
        """Return every file that the step reads, as far as they are there."""
        steps = [self.reference, self.step, *self.earlier.values()]
        paths = [self.calibration, *(path for step in steps for path in step.files)]
        if self.noise is not None:
            paths.append(self.noise)
        if self.step.n != self.reference.n:
            results = {self.reference.n, *([] if self.previous is None else [self.previous]), *self.earlier}
            for n in sorted(results - {self.step.n}):
                paths += [self.folder / name for name in files_of(n)]
            for n in {self.step.n, *([] if self.previous is None else [self.previous])}:
                paths += [self.folder / name for name in files_of(n, "head")]
            paths += [self.folder / name for name in files_of(self.step.n)] if self.compared == "step" else []
        paths.append(self.folder / "mask.png")
        return [path for path in dict.fromkeys(paths) if path.is_file()]

    def moved(self, folder: Path, there: Mapping[Path, Path]) -> StepTask:
        """Return the same step with its files elsewhere, and nothing to be read ahead."""

        def at(step: StepImages) -> StepImages:
            return replace(step, files=(there[step.files[0]], there[step.files[1]]))

        return replace(
            self,
            folder=folder,
            calibration=there[self.calibration],
            reference=at(self.reference),
            step=at(self.step),
            following=None,
            noise=None if self.noise is None else there[self.noise],
            earlier={n: at(step) for n, step in self.earlier.items()},
        )


def files_of(n: int, kind: Earlier = "step") -> tuple[str, str]:
    """Return the names of a step's field and of the starts beside it: of its result, or of its head."""
    starts = "starts" if kind == "step" else "head_starts"
    return f"{kind}_{n:04d}.nc", f"{starts}_{n:04d}.npz"


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
    plan: Plain
    views: list[Plain]


@dataclass(frozen=True, kw_only=True)
class RepairTask:
    """The repair of one calibration.

    Parameters
    ----------
    folder
        Folder of the new calibration; ``calibration.json`` goes there.
    original
        File of the old one, which is only read.
    steps
        Images taken after the bump.
    region
        Where points lie in camera 1's images, as :class:`core.settings.Region`; None: all of them.
    mask
        Image file, white where points may lie, or None.
    subset_px, spacing_px
        As for a measurement.
    limits
        Of :class:`core.orientation.RepairLimits`, by name.
    """

    folder: Path
    original: Path
    steps: list[StepImages]
    region: Plain | None
    mask: Path | None
    subset_px: int
    spacing_px: int | None
    limits: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class LookTask:
    """The target in one pair of images.

    Parameters
    ----------
    rig
        The plan's rig, with the target.
    localiser
        Of line grids.
    pixels, full_scale
        By camera.
    """

    rig: Plain
    localiser: str
    pixels: Plain
    full_scale: dict[str, float]


@dataclass(frozen=True)
class LiveCheckTask:
    """The check of a calibration by one live pair.

    Parameters
    ----------
    calibration
        File of the calibration.
    pixels
        Images of camera 1 and camera 2.
    """

    calibration: Path
    pixels: tuple[Any, Any]


@dataclass(frozen=True)
class LiveFinding:
    """What a live pair says of a calibration.

    Parameters
    ----------
    level
        ``ok``, ``warning``, ``failed`` or ``no_texture``.
    text
        The finding in a sentence.
    offset_px
        How far points lie off their epipolar lines; None: not known.
    own_px
        The calibration's own offset at most; None: not known.
    points
        Points that were matched; 0 where the offset is that of features, or none.
    """

    level: str
    text: str
    offset_px: float | None = None
    own_px: float | None = None
    points: int = 0


@dataclass(frozen=True, kw_only=True)
class LiveTask:
    """A live measurement.

    Parameters
    ----------
    calibration, noise
        Files; no noise models: None.
    settings
        As of an analysis.
    reference
        Images of the reference step.
    gauges
        Each as ``name``, ``kind``, and ``ends_px`` or ``outline``.
    whole_field
        Measure and return all points of the region, not only those that gauges need.
    audit_every
        Frames between two that have all the checks of a step.
    """

    calibration: Path
    settings: StoredSettings
    reference: StepImages
    gauges: list[Plain]
    whole_field: bool
    audit_every: int
    noise: Path | None = None


@dataclass(frozen=True)
class GuideTask:
    """A guided acquisition.

    Parameters
    ----------
    folder
        The calibration's folder, with the views taken.
    plan
        Content of ``plan.json``, with the goal.
    """

    folder: str
    plan: Plain


def warm_up(threads: int) -> None:
    """Load every kernel once, before the first task needs them; those that are not on disk are compiled aside."""
    _heavy("server.compute.measurement").warm_up(threads)


def measure_step(task: StepTask) -> Plain:
    """Measure one step; its result file is readable when this returns. Returns the step's summary."""
    moved = task.step.n != task.reference.n
    summary: Plain = _measuring("server.compute.measurement", motion=moved).measure_step(task)
    return summary


def fit_calibration(task: FitTask) -> Plain:
    """Find the grid in every view and fit both cameras; ``calibration.json`` is there when this returns."""
    summary: Plain = _heavy("server.compute.calibration.fit").fit_calibration(task)
    return summary


def repair_calibration(task: RepairTask) -> Plain:
    """Estimate the cameras' orientation anew; the new ``calibration.json`` is there when this returns."""
    summary: Plain = _measuring("server.compute.orientation_repair").repair_calibration(task)
    return summary


def find_in_pair(task: LookTask) -> dict[str, int]:
    """Find the target in both images; raises as the fit would. Returns the number of points found by camera."""
    found: dict[str, int] = _heavy("server.compute.calibration.guide_session").find_in_pair(task)
    return found


def check_live(task: LiveCheckTask) -> LiveFinding:
    """Say how far a live pair's points lie off their epipolar lines."""
    seen: LiveFinding = _measuring("server.compute.live_check").check_live(task)
    return seen


def begin_live(task: LiveTask) -> Plain:
    """Measure the reference of a live measurement; frames can follow. Returns where its points lie."""
    begun: Plain = _measuring("server.compute.live.frames").begin(task)
    return begun


def measure_live(pixels: Placed, time_s: float) -> Plain:
    """Measure a frame of the live measurement that was begun; returns readings and counts of points by status."""
    found: Plain = _heavy("server.compute.live.frames").measure(pixels.read(), time_s)
    return found


def look_at_pair(task: GuideTask, pixels: Plain, serial: int) -> Plain:
    """Find the target coarsely in a live pair, and say whether it is at rest and new."""
    seen: Plain = _heavy("server.compute.calibration.guide_session").look_at_pair(task, pixels, serial)
    return seen


def guide_views(task: GuideTask, views: list[Plain]) -> Plain:
    """Take up the views that are new, and say what all cover and which view comes next."""
    guidance: Plain = _heavy("server.compute.calibration.guide_session").guide_views(task, views)
    return guidance


def fit_noise(task: NoiseTask) -> Plain:
    """Fit both cameras' noise models; ``noise.json`` is there when this returns."""
    summary: Plain = _heavy("server.compute.noise_fit").fit_noise(task)
    return summary


def _measuring(module: str, *, motion: bool = True) -> Any:
    """Return a module that matches images, once the kernels are there; ``motion``: a displacement's too."""
    _heavy("server.compute.measurement").await_kernels(motion=motion)
    return _heavy(module)


def _heavy(module: str) -> Any:
    return importlib.import_module(module)
