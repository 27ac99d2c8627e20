"""The readings of a set of gauges in every step; missing values are None, with the reason beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class Number:
    """A number with its standard deviation."""

    value: float | None
    sigma: float | None
    units: str


@dataclass(frozen=True)
class PointReading:
    """Variables at a position of camera 1's reference image."""

    name: str | None
    xy_px: tuple[float, float]
    missing: str
    values: Mapping[str, Number]


@dataclass(frozen=True)
class ExtensometerReading:
    """Lengths and strains between two positions."""

    name: str | None
    a_px: tuple[float, float]
    b_px: tuple[float, float]
    missing: str
    values: Mapping[str, Number]


@dataclass(frozen=True)
class Numbers:
    """One number for each position of a line."""

    value: Sequence[float | None]
    sigma: Sequence[float | None]
    units: str


@dataclass(frozen=True)
class LineReading:
    """Variables at positions along a line; ``missing`` gives for each of them the reason why there is none."""

    name: str | None
    x_px: Sequence[float]
    y_px: Sequence[float]
    distance_px: Sequence[float]
    missing: Sequence[str]
    values: Mapping[str, Numbers]


@dataclass(frozen=True)
class AreaStatistics:
    """A variable over the points of an area."""

    units: str
    count: int
    mean: float | None
    mean_sigma: float | None
    sd: float | None
    rms: float | None
    min: float | None
    max: float | None

    @property
    def mean_number(self) -> Number:
        """The mean with its standard deviation."""
        return Number(self.mean, self.mean_sigma, self.units)


@dataclass(frozen=True)
class AreaReading:
    """Variables over an area, which has so many points, so many of them valid."""

    name: str | None
    points: int
    valid: int
    missing: str
    values: Mapping[str, AreaStatistics]


@dataclass(frozen=True)
class FrameReading:
    """The frame that was laid through the surface: X_frame = rotation (X_sys - origin)."""

    rotation: Sequence[Sequence[float]]
    origin_mm: Sequence[float]
    sigma_rad: Sequence[float]
    sigma_origin_mm: Sequence[float]
    residual_rms_mm: float
    points: int


@dataclass(frozen=True)
class RigidMotionReading:
    """The rigid motion that was taken out of a step."""

    values: Mapping[str, Number]
    centre_mm: Sequence[float]
    covariance: Sequence[Sequence[float]]
    points: int
    residual_rms_mm: float
    noise_ratio: float


@dataclass(frozen=True)
class Problem:
    """Reason why a step has no readings."""

    code: str
    cause: str
    remedy: str


@dataclass(frozen=True)
class StepReadings:
    """The readings of one step; none where it has a problem."""

    n: int
    kind: str
    label: str
    load_n: float | None
    problem: Problem | None = None
    rigid_motion: RigidMotionReading | None = None
    points: Sequence[PointReading] = ()
    extensometers: Sequence[ExtensometerReading] = ()
    lines: Sequence[LineReading] = ()
    areas: Sequence[AreaReading] = ()

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        whole = asdict(self)
        if self.problem is not None:
            return {name: whole[name] for name in ("n", "kind", "label", "load_n", "problem")}
        return {k: v for k, v in whole.items() if k != "problem" and (k != "rigid_motion" or v is not None)}


@dataclass(frozen=True)
class GaugeReadings:
    """A set of gauges, read in every step.

    Attributes
    ----------
    settings
        The request.
    inputs_sha256
        Of each result file, by its name.
    stale, stale_reasons
        Inputs or results that are gone or were replaced since.
    frame
        The frame of positions and displacements.
    smoothing_window
        Of the displacements; None: as measured.
    alignment
        None where the frame is the system's.
    """

    software_version: str
    settings: Mapping[str, object]
    inputs_sha256: Mapping[str, str]
    stale: bool
    stale_reasons: Sequence[str]
    frame: str
    subset_px: float
    smoothing_window: int | None
    alignment: FrameReading | None
    steps: Sequence[StepReadings] = field(repr=False)

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
            "inputs_sha256": self.inputs_sha256,
            "alignment": None if self.alignment is None else asdict(self.alignment),
        }

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        whole = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return whole | {"alignment": self.about()["alignment"], "steps": [step.document() for step in self.steps]}
