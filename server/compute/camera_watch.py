"""Watch for a moved camera, step by step: since the calibration, since the reference, since the step before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereorig.core.calibration import COVARIANCE_NAMES
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import SeedError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.slopes import SlopeFilter
from stereorig.core.orientation import judge_offsets
from stereorig.core.orientation.change import Ends, ends_of
from stereorig.core.orientation.coarse import features_off_px
from stereorig.core.orientation.finding import Against
from stereorig.core.orientation.matched import matched_points
from stereorig.core.orientation.offsets import StepOffsets
from stereorig.core.orientation.step import SAMPLE, step_points
from stereorig.server.formats.results.camera_motion import MOVED_REMEDY, MotionCheck

_KEPT = 3
_FAR_PX = 1.0  # starts are looked for within 1.5 px of the epipolar line, features found to 0.7 px
Images = tuple[MeasureImage, MeasureImage]


@dataclass(eq=False)
class CameraWatch:
    """Comparison of the epipolar offsets of a sequence's steps.

    Parameters
    ----------
    pair, options
        The calibrated cameras, and the settings of the measurement.
    reference
        Number of the reference step.
    covariance
        Names and covariance (n, n) of the cameras' parameters, if it is known.
    own_px
        The calibration's own offset at most, if it is known.
    imported
        True for another program's calibration.
    slopes
        Returns the derivative that suits camera 1's reference image, for all steps; None: each step's own is found.
    """

    pair: StereoPair
    options: MeasureOptions
    reference: int
    covariance: tuple[tuple[str, ...], NDArray[np.float64]] | None
    own_px: float | None
    imported: bool
    slopes: Callable[[], SlopeFilter | None] | None = None
    _steps: dict[int, StepOffsets | None] = field(default_factory=dict)

    @cached_property
    def _ends(self) -> Ends:
        return ends_of(self.pair, np.zeros(5))

    def refuse_moved(self, n: int, images: Images, cause: Exception | None = None) -> None:
        """Raise an error for a step without a match, if a camera turned too far for its epipolar lines.

        Raises
        ------
        SeedError
            ``camera_moved``.
        """
        found = cause.context.get("finding") if isinstance(cause, SeedError) else None
        if found not in (None, "off_epipolar_lines"):
            return  # turned, mirrored, of something else: no motion of a camera
        off_px = None if self.imported else features_off_px(self.pair, *images)
        if off_px is not None and off_px > _FAR_PX:
            raise SeedError(
                f"Step {n}: most feature matches between both cameras are about {off_px:.1f} px off their epipolar "
                "lines: a camera moved, or the calibration belongs to another set-up.",
                code="camera_moved",
                remedy=MOVED_REMEDY,
                offset_px=off_px,
            ) from cause

    def judge(
        self,
        n: int,
        result: Field,
        images: Images,
        *,
        shape: Field,
        previous: int | None,
        before: tuple[Field, Images] | None,
    ) -> MotionCheck | None:
        """Judge a step that was measured; it may have been measured and judged before.

        Parameters
        ----------
        n, result, images
            The step.
        shape
            The reference's.
        previous
            Number of the step measured before, None for the first two.
        before
            Field and images of that step, for this comparison alone; None: those it was judged with.

        Returns
        -------
        CameraMotion or None
            None where too few points could be matched.
        """
        if n != self.reference:
            self._steps.pop(n, None)
        step = self._of(n, result, images)
        if step is None:
            return None
        names, covariance = (COVARIANCE_NAMES, None) if self.covariance is None else self.covariance
        against_calibration = judge_offsets(
            self.pair, step, covariance=covariance, names=names, own_px=self.own_px, imported=self.imported
        )
        if n == self.reference:
            return MotionCheck.of(against_calibration, None, None)
        reference = self._of(self.reference, shape, images)
        earlier = None
        if previous is not None and previous != self.reference:
            earlier = self._steps.get(previous) if before is None else self._offsets(previous, *before)
        own_px = None
        if self.imported and reference is not None:
            # offsets at the reference are the unknown error of the calibration, or contain it
            at_reference = judge_offsets(self.pair, reference, names=names, imported=True)
            own_px = None if at_reference is None else at_reference.offset_rms_px
        compared: tuple[tuple[StepOffsets | None, Against], ...] = ((reference, "reference"), (earlier, "last_step"))
        against_reference, against_last = (
            None
            if other is None
            else judge_offsets(
                self.pair, step, before=other, against=name, covariance=covariance, names=names, own_px=own_px
            )
            for other, name in compared
        )
        return MotionCheck.of(against_calibration, against_reference, against_last)

    def _of(self, n: int, result: Field, images: Images) -> StepOffsets | None:
        """Offsets of a step: those known of it, or else of this field and these images, kept from now on."""
        if n not in self._steps:
            self._steps[n] = self._offsets(n, result, images)
            others = [k for k in self._steps if k != self.reference]
            for k in others[: max(len(others) - _KEPT, 0)]:
                del self._steps[k]
        return self._steps[n]

    def _offsets(self, n: int, result: Field, images: Images) -> StepOffsets | None:
        points = (
            matched_points(self.pair, result, self.options.subset_px, at_most=SAMPLE)
            if n == self.reference
            else step_points(self.pair, result, *images, self.options, self.slopes and self.slopes())
        )
        names = COVARIANCE_NAMES if self.covariance is None else self.covariance[0]
        return None if points is None else StepOffsets(self.pair, points, names, ends=self._ends)
