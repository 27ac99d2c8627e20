"""What is worked out of a measured step while the next one is measured: its field as it is shown.

Both take a step's field and images alone, and the steps one after another, on a thread of their own: one, since each
thread keeps memory of its own.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from core.field.checks.extrapolated import mark_extrapolated
from core.field.common import CommonParts
from core.field.points.images import MeasureImage
from core.field.points.result import Field
from core.field.settings import MeasureOptions
from core.matching.image import ImageData
from core.settings import StoredSettings
from core.systematic.interpolation import SmoothSlopes
from core.systematic.terms import Systematic, terms_of
from server.compute.camera_watch import CameraWatch
from server.compute.strain import smoothed_step
from server.formats.calibrations.native import covariance_in
from server.formats.calibrations.recognise import LoadedCalibration
from server.formats.calibrations.volume import own_px_of, parameter_covariance, volume_of
from server.formats.results.camera_motion import CameraMotion

Pair = tuple[MeasureImage, MeasureImage]


@dataclass(frozen=True, eq=False)
class Judged:
    """What is known of a step's cameras, and of the systematic terms of its field."""

    motion: CameraMotion | None
    terms: Systematic


@dataclass(frozen=True, eq=False)
class Begun:
    """A step under way: its field as it is shown, smoothed, marked and with its common part, and what is judged."""

    shown: Future[Field]
    judged: Future[Judged]


class StepsBeside:
    """The steps of one sequence.

    Parameters
    ----------
    calibration, settings, options
        Of the measurement.
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
            # where each step becomes the next one's reference, its own are needed anyhow
            None if settings.reference_update == "always" else lambda: self._prepared(images[0]).slopes,
        )
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="stereorig-beside")
        self._begun: dict[int, Begun] = {}

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
        self._begun[n] = Begun(
            self._thread.submit(self._show, result),
            self._thread.submit(self._judge, n, result, images, shape, previous, before),
        )

    def take(self, n: int) -> Begun:
        """Return a step that was begun, once."""
        return self._begun.pop(n)

    def show_dense(self, field: Field) -> Field:
        """Return a dense field as it is shown: marked, with the common part."""
        return self._dense_common.of(mark_extrapolated(field, self._volume))

    def _show(self, result: Field) -> Field:
        smoothed = smoothed_step(result, self._smoothing_window, subset_px=self._subset_px)
        return self._common.of(mark_extrapolated(smoothed, self._volume))

    def _judge(
        self, n: int, result: Field, images: Pair, shape: Field, previous: int | None, before: tuple[Field, Pair] | None
    ) -> Judged:
        motion = self.watch.judge(n, result, images, shape=shape, previous=previous, before=before)
        compared = (*self._images, *(images if result.has_motion else ()))
        reference, *others = [self._prepared(image) for image in compared]
        if self._smooth is None:
            self._smooth = SmoothSlopes.of(reference)
        return Judged(motion, terms_of(result, self._pair, self._smooth, others, subset_px=self._subset_px))

    def _prepared(self, image: MeasureImage) -> ImageData:
        return image.prepared(self._options.interpolation, None, self._options.blur)
