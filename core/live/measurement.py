"""The measurement of frames as they come, each from the motion of those before it.

A frame is followed (:mod:`stereorig.core.live.follow`): every point starts from the last frame's values, moved on, and
takes one step of the fit, and the checks of single points and of neighbours. Slower measurements whose results change
slowly are made as a step of a sequence is (:class:`stereorig.core.field.sequence.reference_steps.Updating`), with all
its checks: the first frame, every ``audit_every``-th, a frame whose points were lost, and while some are lost every
``retry_every``-th. The ratio of the points' standard deviations to a single fit's, which such a step finds from the
residuals, is used for the frames that follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.volume import CalibratedVolume
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.field.checks.unreached import mark_extrapolated
from stereorig.core.field.common import CommonParts
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.find_visible import with_visibility
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.image_faults import unsure_error
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.live.follow import Follower
from stereorig.core.live.gauges import FrameReadings, GaugeSet, LiveGauge
from stereorig.core.matching.image import ImageData
from stereorig.core.measure import PreviousStep, ReferencePair, Updating
from stereorig.core.noise import NoiseModel
from stereorig.core.settings import DEFAULT_REFERENCE_UPDATE, ReferenceUpdate
from stereorig.core.status import PointStatus
from stereorig.core.threads import run_ranges

Image = np.ndarray | ImageData | MeasureImage

_FURTHEST = 3.0  # intervals over which a velocity is trusted
_MAY_BE_LOST = 0.02  # share of the points: a frame that loses more is measured again, as a step


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of a live measurement.

    Attributes
    ----------
    audit_every
        Frames from one that has all the checks of a step to the next.
    retry_every
        The same while points of the reference are lost, which come back in such a frame.
    whole_field
        Measure all points of the region; False: those that the gauges need.
    """

    audit_every: int = 500
    retry_every: int = 25
    whole_field: bool = False

    def __post_init__(self) -> None:
        for name, value in (("audit_every", self.audit_every), ("retry_every", self.retry_every)):
            if value < 1:
                raise InputError(f"{name} is {value}, it must be 1 or more.", code="option_out_of_range")


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """Result of one frame.

    Attributes
    ----------
    number
        Number of the measured frame, from 1.
    how
        ``followed`` from the frames before, or ``step``: measured as a step of a sequence is, with all its checks.
    field
        The points; those outside the calibrated volume are marked, and points that the gauges use have the
        calibration's common factor.
    readings
        Readings of each gauge, by name.
    """

    number: int
    how: Literal["followed", "step"]
    field: Field
    readings: Mapping[str, FrameReadings]


@dataclass(frozen=True, eq=False)
class _LastFrame:
    """Values that the next frame starts from."""

    number: int
    images: tuple[MeasureImage, MeasureImage]
    field: Field
    time_s: float | None
    before: Field | None  # the frame before it, for the velocity
    before_s: float | None
    ratio: Float | None  # (r, c, 6) standard deviations with all checks over a fit's own; None: not yet known
    rate: float | None  # see Followed
    since_audit: int


@dataclass(eq=False)
class LiveMeasurement:
    """Measures the frames of a test as they come.

    Attributes
    ----------
    reference
        The reference pair's images and the calibrated cameras.
    grid, options
        Points and settings, as of an analysis.
    gauges
        Gauges that are read in each frame.
    live
        Options of the live measurement.
    reference_update
        As of a sequence; a frame that is matched against a later reference is measured as a step, each time.
    noise
        Models of both cameras' single frames; the reference's models are in its images.
    source
        Covariance of the cameras' parameters, if it is known.
    volume
        The calibrated volume, if it is known.

    Raises
    ------
    MeasurementError, RegionError, ImageError
        As :func:`stereorig.core.measure.measure_shape`; ``gauge_outside``.
    """

    reference: ReferencePair
    grid: PointGrid
    options: MeasureOptions
    gauges: Sequence[LiveGauge]
    live: LiveOptions = field(default_factory=LiveOptions)
    reference_update: ReferenceUpdate = DEFAULT_REFERENCE_UPDATE
    noise: tuple[NoiseModel | None, NoiseModel | None] = (None, None)
    source: ParameterCovariance | None = None
    volume: CalibratedVolume | None = None

    def __post_init__(self) -> None:
        self.grid = with_visibility(self.grid, self.options.subset_px)
        whole = self.reference.shape(self.grid, self.options)
        self._set = GaugeSet(self.gauges, self.options.subset_px, whole)
        needed = self._set.needed(self.grid.spacing_px)
        if self.live.whole_field or not self.gauges:
            needed = np.ones(whole.shape, bool)
        self.shape = _masked(whole, needed)
        self._set.shape = self.shape
        self._follower = Follower(self.reference, self.shape, self.grid, self.options)
        self._common = CommonParts(self.pair, self.source)
        self._kept: _LastFrame | None = None
        self._earlier: dict[int, tuple[tuple[MeasureImage, MeasureImage], Field]] = {}
        self._count = 0
        self._updating = Updating(
            self.pair,
            (self.reference.image1, self.reference.image2),
            self.shape,
            self.grid,
            self.options,
            mode=self.reference_update,
            images_of=lambda n: self._earlier_frame(n)[0],
            field_of=lambda n: self._earlier_frame(n)[1],
        )

    @property
    def pair(self) -> StereoPair:
        """The calibrated cameras."""
        return self.reference.pair

    def measure(self, image1: Image, image2: Image, time_s: float | None = None) -> LiveFrame:
        """Measure a frame; one that raises leaves the measurement as it was.

        Parameters
        ----------
        image1, image2
            (rows, cols) camera 1's and camera 2's image.
        time_s
            Time of their exposure, by any clock: a frame after skipped ones has moved on further. If it is not known,
            frames are assumed to be evenly spaced.

        Raises
        ------
        ImageError
            The images cannot be used: ``image_blank``, ``same_image``, ``stale_image``, ``image_size_mismatch``.
        SeedError, MeasurementError
            Nothing of the surface was found.
        """
        images = self._named(image1, image2)
        kept = self._kept
        frame = None if kept is None or self._is_due(kept) else self._follow(images, kept, time_s)
        how: Literal["followed", "step"] = "followed"
        if frame is None:
            how, frame = "step", self._as_step(images, time_s)
        self._keep(frame)
        shown = mark_extrapolated(frame.field, self.volume)
        used = self._set.used(shown)
        if self.source is not None and used.any():
            shown = self._with_common(shown, used)
        return LiveFrame(frame.number, how, shown, self._set.read(shown))

    def _named(self, image1: Image, image2: Image) -> tuple[MeasureImage, MeasureImage]:
        one, two = (
            MeasureImage(image, f"camera {k + 1}'s frame", noise=self.noise[k])
            for k, image in enumerate((image1, image2))
        )
        return one, two

    def _prepare(self, images: tuple[MeasureImage, MeasureImage]) -> None:
        def prepare_some(first: int, last: int) -> None:
            for k in range(first, last):
                images[k].prepared(self.options.interpolation, self.options.noise[k], self.options.blur)

        run_ranges(prepare_some, 2, 1)

    def _is_due(self, kept: _LastFrame) -> bool:
        """Return True for a frame that is to have all checks, or cannot be followed."""
        if self.reference_update == "always" or self.options.blur is not None:
            return True
        if kept.field.references is not None or kept.field.starts is None:
            return True
        lost = bool((self.shape.valid & ~kept.field.valid).any())
        every = min(self.live.retry_every, self.live.audit_every) if lost else self.live.audit_every
        return kept.since_audit + 1 >= every

    def _follow(
        self, images: tuple[MeasureImage, MeasureImage], kept: _LastFrame, time_s: float | None
    ) -> _LastFrame | None:
        """Measure a frame from those before it; None if points that were there are lost."""
        # for a step the ratio is computed now: the step's own values, which took the longest, need not wait for it
        ratio = self._ratio_of(kept) if kept.ratio is None else kept.ratio
        before = None if kept.before is None else (kept.before, _intervals(kept.before_s, kept.time_s, time_s))
        followed = self._follower.measure(images, kept.field, before, ratio, kept.rate)
        if before is not None and self._lost(kept.field, followed.field):  # the motion may have turned
            followed = self._follower.measure(images, kept.field, None, ratio, kept.rate)
        if self._lost(kept.field, followed.field):
            return None
        return _LastFrame(
            number=self._count + 1,
            images=images,
            field=followed.field,
            time_s=time_s,
            before=kept.field,
            before_s=kept.time_s,
            ratio=ratio,
            rate=followed.rate,
            since_audit=kept.since_audit + 1,
        )

    @staticmethod
    def _lost(before: Field, now: Field) -> bool:
        """Return True if more points are lost than may be in a followed frame."""
        lost = int((before.valid & ~now.valid & (now.status != PointStatus.OUTSIDE_IMAGE)).sum())
        return lost > _MAY_BE_LOST * before.valid.sum() or not now.valid.any()

    def _as_step(self, images: tuple[MeasureImage, MeasureImage], time_s: float | None) -> _LastFrame:
        """Measure a frame as a step of a sequence is."""
        self._prepare(images)
        kept, number = self._kept, self._count + 1
        previous = None if kept is None else PreviousStep(kept.number, kept.field)
        field = self._updating.measure(images, previous)
        if not field.valid.any():
            if field.unsure is not None:
                raise unsure_error(
                    "the frame",
                    self.pair,
                    (self.reference.image1, self.reference.image2),
                    images,
                    field.unsure,
                    subset_px=self.options.subset_px,
                    region_px=self.grid.extent_px,
                )
            raise MeasurementError(
                "No point of the frame could be measured.",
                code="nothing_measured",
                remedy="Check that both cameras see the surface, and that nothing hides it.",
            )
        return _LastFrame(number, images, field, time_s, None, None, None, None, 0)

    def _ratio_of(self, step: _LastFrame) -> Float:
        """Return a step's standard deviations over those that a single fit states (r, c, 6); 1 at missing points."""
        field = step.field
        ratio = np.ones((*field.shape, 6))
        own = self._follower.measure(step.images, field, None, ratio, None).field
        there = field.valid & own.valid
        with_checks, alone = (np.diagonal(f.covariance[there], axis1=1, axis2=2) for f in (field, own))
        ratio[there] = np.sqrt(with_checks / alone)
        return ratio

    def _keep(self, frame: _LastFrame) -> None:
        references = frame.field.references
        there = {frame.number: (frame.images, frame.field)}
        if references is not None:
            wanted = {references.step, *np.unique(references.steps).tolist()}
            there |= {n: earlier for n, earlier in self._earlier.items() if n in wanted}
        self._earlier, self._kept, self._count = there, frame, frame.number

    def _earlier_frame(self, n: int) -> tuple[tuple[MeasureImage, MeasureImage], Field]:
        if n not in self._earlier:
            raise MeasurementError(
                f"Frame {n} is not kept any more.", code="frame_gone", remedy="Begin the live measurement again."
            )
        return self._earlier[n]

    def _with_common(self, shown: Field, used: Bool) -> Field:
        """Return the field with the common factor of the points that gauges use."""
        found = self._common.of(_masked(shown, used))
        return replace(shown, common=found.common, causes=found.causes)


def _intervals(before_s: float | None, last_s: float | None, now_s: float | None) -> float:
    """Return the time to a frame over the time between the two before it, at most ``_FURTHEST``.

    1 if it is not known.
    """
    if before_s is None or last_s is None or now_s is None or not before_s < last_s < now_s:
        return 1.0
    return min((now_s - last_s) / (last_s - before_s), _FURTHEST)


def _masked(field: Field, left: Bool) -> Field:
    """Return the field with the points ``left`` (r, c) alone; the others count as outside the region."""
    return replace(field, status=np.where(left, field.status, np.int8(PointStatus.MASKED)))
