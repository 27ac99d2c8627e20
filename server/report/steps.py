"""One pass over the result files: the figures of each step, and the few fields that are drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np

from stereorig.core.field.checks.epipolar_offset import EpipolarCheck
from stereorig.core.field.points.result import Field
from stereorig.core.names import CameraName
from stereorig.core.progress import Progress, no_progress
from stereorig.core.settings import Coverage, CoverageFields
from stereorig.core.strain import StrainField
from stereorig.server.compute.strain import StrainSummary, summarise_strain
from stereorig.server.documents.steps import StepQuality, StepRecord
from stereorig.server.documents.tests import CameraMotion
from stereorig.server.formats.calibrations.volume import rbe_of
from stereorig.server.formats.channel_units import channel_title
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.summary import ROWS_APART, StepSummary, summarise
from stereorig.server.formats.results.uncertainty import Included, Statement, read_included
from stereorig.server.report.floor import LENGTHS, STRAINS, Floor, FloorKeeper, Quantity, reported_sigma, static_steps
from stereorig.server.report.source import Source
from stereorig.server.results.channels import units_of


@dataclass(frozen=True, eq=False)
class DrawnStep:
    """A step whose field is drawn."""

    n: int
    why: str
    field: Field
    strain: StrainField | None


@dataclass(frozen=True)
class StepRow:
    """Figures of one step in the tables.

    Attributes
    ----------
    n, label, load_n, channels, channel_u, units
        As the step's record has them.
    seconds
        Time since the reference, s; None if the times are not known.
    summary, strain
        As :func:`summarise` and :func:`summarise_strain` make them.
    skew_ms, skew_by, quality
        Skew and quality of the pair of images; None if not recorded. ``skew_by``: uncertainty and source of the skew.
    static
        True if it counts as static.
    camera_motion
        Finding about a motion of the cameras; None if it was not judged.
    """

    n: int
    label: str
    load_n: float | None
    channels: dict[str, float]
    seconds: float | None
    captured_utc: str | None
    summary: StepSummary
    strain: StrainSummary | None
    skew_ms: float | None
    quality: StepQuality | None
    static: bool
    camera_motion: CameraMotion | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    channel_u: Mapping[str, float] = field(default_factory=dict)
    skew_by: str | None = None

    def temperature_c(self, cam: CameraName) -> float | None:
        """Temperature that a camera reported, degrees Celsius; None if it reported none."""
        image = getattr(self.quality, cam, None)
        return None if image is None else image.temperature_c

    @property
    def cameras(self) -> str:
        """Finding about the cameras in a word; empty if there is none."""
        if self.camera_motion is None:
            return ""
        return {True: "moved", False: "at rest", None: "not known"}[self.camera_motion.camera_moved]

    @property
    def min_zncc(self) -> float | None:
        """Minimum of the comparisons' medians."""
        return min((v for v in self.summary.zncc_median.values() if v is not None), default=None)

    @property
    def sigma_um(self) -> list[float | None]:
        """Median standard deviations of X, Y, Z, U, V, W."""
        medians = (self.summary.sigma_median_mm.get(f"{k}_mm") for k in "xyzuvw")
        return [None if mm is None else 1e3 * mm for mm in medians]

    @property
    def max_displacement_mm(self) -> float | None:
        """Maximum component of any point's displacement; None for a shape."""
        moved = self.summary.displacement_mm or {}
        ends = [abs(v) for component in moved.values() if component for v in (component.min, component.max)]
        return max(ends) if ends else None


@dataclass(frozen=True, eq=False)
class MeasuredSteps:
    """Content of the result files.

    Attributes
    ----------
    steps
        Ascending.
    reference, reference_sys
        The shape that everything is relative to, in the report's frame, and in the system frame of the calibration.
    shown
        Steps that are drawn: the peak and the last; of shapes, the last.
    floor
        By quantity; empty without static steps.
    static, static_source, static_left_out
        Steps of the floor, the source that names them, and the steps that did not fit into memory.
    reported
        Median of the predicted standard deviations by quantity, of the first displacement or else of the shape.
    noise_grey
        Median noise of the reference image from the residuals of the matching.
    statement
        Statement with the uncertainties: the coverage factor, and the terms that they include in all steps.
    """

    steps: list[StepRow]
    reference: Field
    reference_sys: Field
    shown: list[DrawnStep]
    floor: dict[str, Floor]
    static: list[int]
    static_source: str
    static_left_out: list[int]
    reported: dict[str, float | None]
    noise_grey: float | None
    statement: Statement

    @property
    def quantities(self) -> list[Quantity]:
        """Return the noise of each quantity, as far as it is known."""
        return [
            Quantity(name, self.floor.get(name), self.reported.get(name))
            for name in (*LENGTHS, *STRAINS)
            if name in self.floor or name in self.reported
        ]

    @property
    def loaded(self) -> bool:
        """Return True if any step has a load."""
        return any(s.load_n is not None for s in self.steps)

    @property
    def channels(self) -> list[str]:
        """Names of the first four channels that were recorded."""
        return sorted({name for s in self.steps for name in s.channels})[:4]

    @property
    def channel_titles(self) -> list[str]:
        """Their names with their units."""
        units = {name: unit for s in self.steps for name, unit in s.units.items()}
        return [channel_title(name, units.get(name)) for name in self.channels]

    @property
    def moved(self) -> list[StepRow]:
        """Steps with displacements."""
        return [s for s in self.steps if s.summary.displacement_mm]

    @property
    def reference_step(self) -> int | None:
        """Number of the step that displacements are relative to; None for shapes alone."""
        if not self.moved:
            return None
        return next((s.n for s in self.steps if not s.summary.displacement_mm), None)

    @property
    def camera_moved(self) -> list[StepRow]:
        """Steps in which a camera is seen to have moved."""
        return [s for s in self.steps if s.camera_motion is not None and s.camera_motion.camera_moved]

    @property
    def worst_epipolar(self) -> EpipolarCheck | None:
        """The epipolar check with the largest offset of all steps; None if none could be made."""
        checks = [s.summary.epipolar_check for s in self.steps if s.summary.epipolar_check is not None]
        return max(checks, key=lambda c: c.offset_px, default=None)


def read_steps(
    source: Source, coverage: CoverageFields | None = None, progress: Progress = no_progress
) -> MeasuredSteps:
    """Read every result file once; at most three fields are held at a time, and the static steps' values.

    Parameters
    ----------
    source
        Result files, records, calibration and metadata.
    coverage
        Coverage of the stated uncertainties; None or without a factor: the metadata's gauges'.
    progress
        Receives each step that is read.
    """
    labels = {n: _label(source, n) for n in source.files}
    static, static_source = static_steps(source.metadata.static_steps, labels, source.reference)
    rbe = None if source.calibration is None else rbe_of(source.calibration)
    imported = source.calibration is not None and source.calibration.imported
    keeper = FloorKeeper()
    figures: list[StepRow] = []
    included: list[Included] = []
    reference: Field | None = None
    peak: DrawnStep | None = None
    last: DrawnStep | None = None
    height = -np.inf
    reported: dict[str, float | None] = {}
    loads = {n: _load(source, n) for n in source.files}
    by_load = all(load is not None for load in loads.values()) and len(set(loads.values())) > 1
    for k, (n, path) in enumerate(source.files.items()):
        progress("reading", k, len(source.files))
        field, strain = read_field(path), read_strain(path)
        if n in static:
            keeper.add(n, field, strain)
        step = _figures(source, n, field, strain, rbe, labels[n], static=n in static, imported=imported)
        figures.append(step)
        included.append(read_included(path))
        if reference is None:
            reference = field
        if not reported or ("U" not in reported and field.has_motion):
            reported = reported_sigma(field, strain)
        if n == source.reference and field.has_motion is False:
            reference = field
        if n == source.reference and len(source.files) > 1:
            continue
        last = DrawnStep(n, "the last step", field, strain)
        size = abs(loads[n] or 0.0) if by_load else step.max_displacement_mm
        if size is not None and size > height:
            why = "the step of maximum load" if by_load else "the step of maximum displacement"
            height, peak = size, DrawnStep(n, why, field, strain)
    assert reference is not None
    shown = [s for s in (peak, last) if s is not None]
    if len(shown) == 2 and shown[0].n == shown[1].n:
        shown = [DrawnStep(shown[0].n, f"{shown[0].why}, and the last", shown[0].field, shown[0].strain)]
    grey = reference.noise_grey[reference.valid]
    grey = grey[np.isfinite(grey)]
    return MeasuredSteps(
        steps=figures,
        reference=reference,
        reference_sys=read_field(source.stored[source.reference]) if source.reference in source.stored else reference,
        shown=shown,
        floor=keeper.result(),
        static=keeper.steps,
        static_source=static_source,
        static_left_out=keeper.left_out,
        reported=reported,
        noise_grey=float(np.median(grey)) if grey.size else None,
        statement=Statement(Included.in_all(included), _coverage(source, coverage)),
    )


def _coverage(source: Source, asked: CoverageFields | None) -> CoverageFields:
    for one in (asked, source.metadata.gauges):
        if one is not None and (one.k is not None or one.coverage is not None):
            return Coverage(k=one.k, coverage=one.coverage)
    return Coverage(k=None, coverage=None)


def _label(source: Source, n: int) -> str:
    return source.steps[n].label or source.heads[n].label


def _load(source: Source, n: int) -> float | None:
    recorded = source.steps[n].load_n
    if recorded is not None or "load_n" in source.steps[n].model_fields_set:
        return recorded
    return source.heads[n].load_n


def _figures(
    source: Source,
    n: int,
    field: Field,
    strain: StrainField | None,
    rbe: float | None,
    label: str,
    *,
    static: bool,
    imported: bool,
) -> StepRow:
    record = source.steps[n]
    return StepRow(
        n=n,
        label=label,
        load_n=_load(source, n),
        channels=record.channels,
        seconds=_seconds(source, n),
        captured_utc=record.captured_utc,
        summary=summarise(
            field,
            rbe_px=rbe,
            reference=source.reference,
            imported=imported,
            rows_apart=str(source.heads[n].attributes.get(ROWS_APART, "")),
        ),
        strain=None if strain is None else summarise_strain(strain, field),
        skew_ms=record.skew_ms,
        quality=record.quality,
        static=static,
        camera_motion=source.camera_motion.get(n),
        units=units_of(record.channels, record.channel_units),
        channel_u=record.channel_u,
        skew_by=_skew_by(record),
    )


def _skew_by(record: StepRecord) -> str | None:
    source, uncertainty = record.skew_source, record.skew_uncertainty_ms
    return None if source is None or uncertainty is None else f"+- {uncertainty:.2g} ms by {source}"


def _seconds(source: Source, n: int) -> float | None:
    """Time since the reference, by the host's monotonic clock where both have it, else by the wall clock."""
    one, two = source.reference_step, source.steps[n]
    if "import" in (one.source, two.source):
        return None  # the time of an import is not the time of the exposure
    begin, end = one.host_monotonic_ns, two.host_monotonic_ns
    # the clock starts again with the machine: it is used only if it also agrees with the order of the steps
    if begin is not None and end is not None and (end - begin) * (n - source.reference) >= 0:
        return (end - begin) / 1e9
    try:
        times = [datetime.fromisoformat(str(step.captured_utc)) for step in (one, two)]
    except ValueError:
        return None
    return (times[1] - times[0]).total_seconds()
