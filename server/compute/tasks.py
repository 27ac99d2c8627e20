"""Descriptions of the tasks of a compute worker: plain values, paths and arrays, which pickle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from stereorig.core.names import CAMERAS
from stereorig.core.settings import StoredSettings
from stereorig.server.formats.results.folder import DENSE
from stereorig.server.worker.executor import FileTask

#: values that cross the process' border: numbers, texts, lists and objects of them
Plain = dict[str, Any]
#: kind of a step's field: measured as the step after another one, or as the head of a block
Earlier = Literal["step", "head"]


@dataclass(frozen=True, kw_only=True)
class StepImages:
    """One step's images, and their origin.

    Attributes
    ----------
    n
        Number of the step.
    files, sha256
        Of camera 1 and camera 2.
    averages
        Number of frames that each is the mean of, and the factor of its grey levels.
    grey_from
        Origin of the grey levels of camera 1 and camera 2, see :class:`stereorig.server.formats.images.Decoded`.
    saturated
        Share of both images' pixels at full scale; None if each step's record has it.
    """

    n: int
    files: tuple[Path, Path]
    sha256: tuple[str, str]
    averages: tuple[int, float] = (1, 1.0)
    grey_from: tuple[str | None, str | None] = (None, None)
    saturated: tuple[float, float] | None = None


def grey_from_of(step: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """Return the origin of the grey levels of both cameras' images of a step, from its record."""
    known = step.get("grey_from")
    one, two = ((known if isinstance(known, dict) else {}).get(cam) for cam in CAMERAS)
    return one, two


def averages_of(step: Mapping[str, Any]) -> tuple[int, float]:
    """Number of frames that a step's images are means of, and the factor on their grey levels."""
    return int(step.get("frames") or 1), float(step.get("grey_scale") or 1.0)


@dataclass(frozen=True, kw_only=True)
class StepTask(FileTask):
    """One step of one analysis; plain paths and values, so that any executor can carry it.

    Parameters
    ----------
    folder
        The analysis' folder; the result goes there as ``step_<nnnn>.nc``.
    calibration
        Path of the test's calibration.
    settings
        Settings of the analysis.
    reference
        The step whose shape is measured first.
    step
        The step to measure; the reference itself for its shape.
    previous
        Number of the step measured before, whose field gives start values.
    about
        Further text attributes of the result file.
    following
        The step that will probably be asked for next, to be read during this one.
    noise
        Path of the noise models, or None.
    earlier
        By number, the steps after the reference that this one may be matched against: later references, and the step
        before it.
    keeps_starts
        True if later steps start from this one's matches.
    against
        Reference that the step is matched against from seeds, without the steps between: the head of a block of steps
        that are measured side by side with others. Its field goes to ``head_<nnnn>.nc``, and there is no result.
    from_head
        True if the previous step's field is its head's.
    compared
        The earlier field of the step, its head or its result: the summary has under ``agrees`` True if steps that
        were measured from it remain valid. None: there is none.
    generation
        Larger once results have been replaced: what a process has kept of them is not theirs any more.
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

    def results(self) -> list[str]:
        """Return the names of the files that the step may write: a dense field, its starts, and its result last."""
        if self.against is not None:
            return [*reversed(files_of(self.step.n, "head"))]
        result, starts = files_of(self.step.n)
        return [f"{DENSE}/{result}", starts, result]

    def read_once(self) -> set[Path]:
        """Return the step's images; the reference's are read by every step."""
        return set(self.step.files) - set(self.reference.files)


def files_of(n: int, kind: Earlier = "step") -> tuple[str, str]:
    """Return the names of a step's field and of its starts' file: of its result, or of its head."""
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
        Region of the points in camera 1's images, as :class:`stereorig.core.settings.Region`; None: all of them.
    mask
        Image file, white where points are allowed, or None.
    subset_px, spacing_px
        As for a measurement.
    limits
        Of :class:`stereorig.core.orientation.RepairLimits`, by name.
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
    """Finding about a calibration from a live pair.

    Parameters
    ----------
    level
        ``ok``, ``warning``, ``failed`` or ``no_texture``.
    text
        The finding in a sentence.
    offset_px
        Distance of points from their epipolar lines; None: not known.
    own_px
        The calibration's own offset at most; None: not known.
    points
        Points that were matched; 0 if the offset is from features, or not known.
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
