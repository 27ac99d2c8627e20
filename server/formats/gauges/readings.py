"""The readings of a set of gauges in every step; a missing value is None, with its reason in the same entry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated

from pydantic import Field

from stereorig.server.formats.channel_units import unit_of
from stereorig.server.formats.results.uncertainty import Statement

EXPANDED = "k times the standard uncertainty, if another k than 1 was asked for."
LACKING = "`calibration not included` if so, else empty."
_BUDGET = (
    "Standard uncertainties by cause, whose squares add up to the square of the whole: `matching` (noise that is "
    "new at each step), `reference` (noise of the reference pair, the same in all steps of a test), `calibration` "
    "(noise of its views), `stage`, `target`; `sensor` (pull of camera 1's fixed pattern) if one was found. Unknown "
    "causes are left out, see the step's `not_told`; null without any."
)


@dataclass(frozen=True)
class Number:
    """A number with its standard deviation."""

    value: Annotated[float | None, Field(description="The value; null if it is missing.")]
    sigma: Annotated[float | None, Field(description="Standard uncertainty; null if it is not known.")]
    units: Annotated[str, Field(description="Unit; `1` of a number without one.")]
    sigma_calibration: Annotated[
        float | None, Field(description="The calibration's part of sigma; null if it is not known and not included.")
    ] = None
    budget: Annotated[Mapping[str, float] | None, Field(description=_BUDGET)] = None
    expanded: Annotated[float | None, Field(description=EXPANDED)] = None
    not_included: Annotated[str, Field(description=LACKING)] = ""


@dataclass(frozen=True)
class PointReading:
    """Variables at a position of camera 1's reference image."""

    name: Annotated[str | None, Field(description="Name of the point, if it has one.")]
    xy_px: Annotated[tuple[float, float], Field(description="Position in camera 1's reference image.")]
    missing: Annotated[str, Field(description="Reason why there are no values; empty if there are.")]
    values: Annotated[Mapping[str, Number], Field(description="Values by variable.")]


@dataclass(frozen=True)
class ExtensometerReading:
    """Lengths and strains between two positions."""

    name: Annotated[str | None, Field(description="Name of the extensometer, if it has one.")]
    a_px: Annotated[tuple[float, float], Field(description="First end in camera 1's reference image.")]
    b_px: Annotated[tuple[float, float], Field(description="Second end in camera 1's reference image.")]
    missing: Annotated[str, Field(description="Reason why there are no values; empty if there are.")]
    values: Annotated[Mapping[str, Number], Field(description="Lengths, elongation and strains by name.")]


@dataclass(frozen=True)
class Numbers:
    """One number for each position of a line."""

    value: Annotated[Sequence[float | None], Field(description="Value at each position; null if it is missing.")]
    sigma: Annotated[
        Sequence[float | None], Field(description="Standard uncertainty at each position; null if it is not known.")
    ]
    units: Annotated[str, Field(description="Unit; `1` of numbers without one.")]
    sigma_calibration: Annotated[
        Sequence[float | None],
        Field(description="The calibration's part of each sigma; null if it is not known and not included."),
    ] = ()
    budget: Annotated[Mapping[str, Sequence[float | None]] | None, Field(description=_BUDGET)] = None
    expanded: Annotated[Sequence[float | None], Field(description=f"{EXPANDED} Empty: none was asked for.")] = ()
    not_included: Annotated[str, Field(description=LACKING)] = ""


@dataclass(frozen=True)
class LineReading:
    """Variables at positions along a line; ``missing`` gives for each of them the reason why there is none."""

    name: Annotated[str | None, Field(description="Name of the line, if it has one.")]
    x_px: Annotated[Sequence[float], Field(description="Column of each position in camera 1's reference image.")]
    y_px: Annotated[Sequence[float], Field(description="Row of each position in camera 1's reference image.")]
    distance_px: Annotated[
        Sequence[float], Field(description="Distance of each position from the start, along the line.")
    ]
    missing: Annotated[
        Sequence[str], Field(description="Reason for each position without values; empty if it has them.")
    ]
    values: Annotated[Mapping[str, Numbers], Field(description="Values along the line by variable.")]


@dataclass(frozen=True)
class AreaStatistics:
    """A variable over the points of an area."""

    units: Annotated[str, Field(description="Unit; `1` of a variable without one.")]
    count: Annotated[int, Field(description="Number of values.")]
    mean: Annotated[float | None, Field(description="Mean.")]
    mean_sigma: Annotated[float | None, Field(description="Standard uncertainty of the mean; null if it is not known.")]
    sd: Annotated[float | None, Field(description="Standard deviation over the area.")]
    rms: Annotated[float | None, Field(description="Root of the mean square.")]
    min: Annotated[float | None, Field(description="Smallest value.")]
    max: Annotated[float | None, Field(description="Largest value.")]
    mean_sigma_calibration: Annotated[
        float | None,
        Field(description="The calibration's part of mean_sigma; null if it is not known and not included."),
    ] = None
    mean_budget: Annotated[Mapping[str, float] | None, Field(description=_BUDGET)] = None
    mean_expanded: Annotated[float | None, Field(description=EXPANDED)] = None
    not_included: Annotated[str, Field(description=LACKING)] = ""

    @property
    def mean_number(self) -> Number:
        """The mean with its standard deviation."""
        return Number(
            self.mean,
            self.mean_sigma,
            self.units,
            self.mean_sigma_calibration,
            self.mean_budget,
            expanded=self.mean_expanded,
            not_included=self.not_included,
        )


@dataclass(frozen=True)
class AreaReading:
    """Variables over an area, which has so many points, so many of them valid."""

    name: Annotated[str | None, Field(description="Name of the area, if it has one.")]
    points: Annotated[int, Field(description="Points in the area.")]
    valid: Annotated[int, Field(description="Valid ones among them.")]
    missing: Annotated[str, Field(description="Reason why there are no values; empty if there are.")]
    values: Annotated[Mapping[str, AreaStatistics], Field(description="Statistics by variable.")]


@dataclass(frozen=True)
class FrameReading:
    """The frame that the surface defines: X_frame = rotation (X_sys - origin)."""

    rotation: Annotated[Sequence[Sequence[float]], Field(description="Rotation matrix, row by row.")]
    origin_mm: Annotated[Sequence[float], Field(description="Origin in the system frame.")]
    sigma_rad: Annotated[Sequence[float], Field(description="Standard uncertainty of the rotation about each axis.")]
    sigma_origin_mm: Annotated[
        Sequence[float], Field(description="Standard uncertainty of the origin along each axis.")
    ]
    residual_rms_mm: Annotated[float, Field(description="Root mean square distance of the points from the fit.")]
    points: Annotated[int, Field(description="Points that it was fitted to.")]
    budget_rad: Annotated[Sequence[Mapping[str, float]], Field(description="Budget of each rotation's sigma.")] = ()
    budget_origin_mm: Annotated[
        Sequence[Mapping[str, float]], Field(description="Budget of the origin's sigma along each axis.")
    ] = ()
    not_included: Annotated[str, Field(description=LACKING)] = ""


@dataclass(frozen=True)
class RigidMotionReading:
    """The rigid motion that was taken out of a step."""

    values: Annotated[Mapping[str, Number], Field(description="Rotation and translation by component.")]
    centre_mm: Annotated[Sequence[float], Field(description="Centre of the rotation.")]
    covariance: Annotated[
        Sequence[Sequence[float]],
        Field(description="Joint covariance of the three rotations (rad) and the three translations (mm)."),
    ]
    points: Annotated[int, Field(description="Points that it was fitted to.")]
    residual_rms_mm: Annotated[float, Field(description="Root mean square of the displacements that remain.")]
    noise_ratio: Annotated[float, Field(description="Residual over that expected from the uncertainty of the points.")]


@dataclass(frozen=True)
class DifferenceReading:
    """A gauge's reading in a step minus its reading in another; errors that both steps share cancel."""

    gauge: Annotated[str | None, Field(description="Name of the gauge.")]
    kind: Annotated[str, Field(description="`point`, `extensometer` or `area`, whose means are taken.")]
    values: Annotated[Mapping[str, Number], Field(description="Differences by variable.")]


@dataclass(frozen=True)
class StepProblem:
    """Reason why a step has no readings."""

    code: str
    detail: str
    remedy: str


@dataclass(frozen=True)
class StepReadings:
    """The readings of one step; empty if it has a problem.

    Attributes
    ----------
    not_told
        The causes that the budgets cannot separate, and the terms that they do not include.
    differences
        Differences from the step that was asked for; empty if none was asked for, and in that step itself.
    """

    n: int
    kind: str
    label: str
    load_n: float | None
    time_s: float | None = None
    channels: Mapping[str, float] = field(default_factory=dict)
    channel_units: Mapping[str, str] = field(default_factory=dict)
    channel_u: Mapping[str, float] = field(default_factory=dict)
    problem: StepProblem | None = None
    rigid_motion: RigidMotionReading | None = None
    points: Sequence[PointReading] = ()
    extensometers: Sequence[ExtensometerReading] = ()
    lines: Sequence[LineReading] = ()
    areas: Sequence[AreaReading] = ()
    not_told: Sequence[str] = ()
    differences: Sequence[DifferenceReading] = ()

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        whole = asdict(self)
        if self.problem is not None:
            return {name: whole[name] for name in ("n", "kind", "label", "load_n", "time_s", "channels", "problem")}
        left = ("problem", "channel_units")
        return {k: v for k, v in whole.items() if k not in left and (k != "rigid_motion" or v)}


@dataclass(frozen=True)
class GaugeReadings:
    """A set of gauges, read in every step.

    Attributes
    ----------
    settings
        The request.
    calibration
        ``id``, None if it is not known, and ``sha256`` of the calibration that was measured with.
    inputs_sha256
        SHA-256 of each result file, by its name.
    stale, stale_reasons
        Inputs or results that are gone or were replaced since.
    frame
        The frame of positions and displacements.
    smoothing_window
        Smoothing window of the displacements, points; None: as measured.
    alignment
        None if the frame is the system's.
    statement
        The uncertainties' meaning, and the terms that they include in all steps.
    """

    software_version: str
    settings: Mapping[str, object]
    calibration: Mapping[str, str | None]
    inputs_sha256: Mapping[str, str]
    stale: bool
    stale_reasons: Sequence[str]
    frame: str
    subset_px: float
    smoothing_window: int | None
    alignment: FrameReading | None
    statement: Statement
    steps: Sequence[StepReadings] = field(repr=False)

    @property
    def channel_units(self) -> dict[str, str]:
        """The unit of each channel that any step has."""
        found: dict[str, str] = {}
        for step in self.steps:
            for name in step.channels:
                found.setdefault(name, step.channel_units.get(name) or unit_of(name))
        return dict(sorted(found.items()))

    @property
    def read(self) -> list[StepReadings]:
        """The steps that could be read."""
        return [step for step in self.steps if step.problem is None]

    def about(self) -> dict[str, object]:
        """Return the entries above a table of readings."""
        return {
            "software_version": self.software_version,
            "stale_reasons": self.stale_reasons,
            "frame": self.frame,
            "subset_px": self.subset_px,
            "smoothing_window": self.smoothing_window,
            "settings": self.settings,
            "calibration": self.calibration,
            "inputs_sha256": self.inputs_sha256,
            "alignment": None if self.alignment is None else asdict(self.alignment),
            "uncertainty": self.statement.document(),
            **({"channel_units": self.channel_units} if self.channel_units else {}),
        }

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        whole = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "statement"}
        whole["channel_units"] = self.channel_units
        about = self.about()
        steps = [step.document() for step in self.steps]
        return whole | {"alignment": about["alignment"], "uncertainty": about["uncertainty"], "steps": steps}
