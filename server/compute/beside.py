"""Work on a measured step that runs while the next one is measured: smoothing, camera watch, systematic terms.

Both take a step's field and images alone, and the steps one after another, on a thread of their own: one, since each
thread keeps memory of its own.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from stereorig.core.field.checks.unreached import mark_extrapolated
from stereorig.core.field.common import CommonParts
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.image import ImageData
from stereorig.core.settings import StoredSettings
from stereorig.core.systematic.interpolation import SmoothSlopes
from stereorig.core.systematic.sensor_pull import FixedLines, fixed_lines
from stereorig.core.systematic.terms import Systematic, terms_of
from stereorig.server.compute.camera_watch import CameraWatch
from stereorig.server.compute.strain import smoothed_step
from stereorig.server.formats.calibrations.native import covariance_in
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.calibrations.volume import own_px_of, parameter_covariance, volume_of
from stereorig.server.formats.results.camera_motion import MotionCheck

Pair = tuple[MeasureImage, MeasureImage]


@dataclass(frozen=True, eq=False)
class StepFindings:
    """Findings about a step's cameras, and the systematic terms of its field."""

    motion: MotionCheck | None
    terms: Systematic


@dataclass(frozen=True, eq=False)
class StepUnderWay:
    """A step under way: its field as it is shown, its sensor's fixed lines, and the findings about it."""

    shown: Future[tuple[Field, FixedLines | None]]
    judged: Future[StepFindings]


class StepsBeside:
    """The steps of one sequence.

    Parameters
    ----------
    calibration, settings, options
        The measurement's calibration, settings and options.
    reference
        Number of the reference step.
    images
        Its two images.

    Attributes
    ----------
    watch
        The cameras' watch over these steps.
    """

    def __init__(
        self,
        calibration: LoadedCalibration,
        settings: StoredSettings,
        options: MeasureOptions,
        reference: int,
        images: Pair,
    ) -> None:
        self._pair, self._options, self._images = calibration.pair, options, images
        self._smoothing_window, self._subset_px = settings.smoothing_window, settings.subset_px
        self._volume = volume_of(calibration)
        source = parameter_covariance(calibration)
        self._common, self._dense_common = (CommonParts(calibration.pair, source) for _ in range(2))
        self._smooth: SmoothSlopes | None = None
        self.watch = CameraWatch(
            calibration.pair,
            options,
            reference,
            covariance_in(calibration.details, name="calibration.json", pair=calibration.pair),
            own_px_of(calibration),
            calibration.imported,
            # if each step becomes the next one's reference, its own slopes are needed anyhow
            None if settings.reference_update == "always" else lambda: self._prepared(images[0]).slopes,
        )
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="stereorig-beside")
        self._begun: dict[int, StepUnderWay] = {}

    def begin(
        self,
        n: int,
        result: Field,
        images: Pair,
        *,
        shape: Field,
        previous: int | None,
        before: tuple[Field, Pair] | None,
    ) -> None:
        """Begin with a step that was measured; parameters as of :meth:`CameraWatch.judge`."""
        self._begun[n] = StepUnderWay(
            self._thread.submit(self._show, result, images),
            self._thread.submit(self._judge, n, result, images, shape, previous, before),
        )

    def take(self, n: int) -> StepUnderWay:
        """Return a step that was begun, once."""
        return self._begun.pop(n)

    def show_dense(self, field: Field) -> Field:
        """Return a dense field as it is shown: marked, with the common part."""
        return self._dense_common.of(mark_extrapolated(field, self._volume))

    def _show(self, result: Field, images: Pair) -> tuple[Field, FixedLines | None]:
        smoothed = smoothed_step(result, self._smoothing_window, subset_px=self._subset_px)
        lines = None
        if result.has_motion:
            first, now = (self._prepared(pair[0]) for pair in (self._images, images))
            lines = fixed_lines(result, self._pair, first, now, subset_px=self._subset_px)
        shown = mark_extrapolated(smoothed, self._volume)
        return self._common.of(shown, None if lines is None else lines.pull_mm), lines

    def _judge(
        self, n: int, result: Field, images: Pair, shape: Field, previous: int | None, before: tuple[Field, Pair] | None
    ) -> StepFindings:
        motion = self.watch.judge(n, result, images, shape=shape, previous=previous, before=before)
        compared = (*self._images, *(images if result.has_motion else ()))
        reference, *others = [self._prepared(image) for image in compared]
        if self._smooth is None:
            self._smooth = SmoothSlopes.of(reference)
        return StepFindings(motion, terms_of(result, self._pair, self._smooth, others, subset_px=self._subset_px))

    def _prepared(self, image: MeasureImage) -> ImageData:
        return image.prepared(self._options.interpolation, None, self._options.blur)
