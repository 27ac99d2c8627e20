"""The dense fields of a sequence's steps: measured in addition to the ordinary ones, from the same images."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import METHOD
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.settings import MeasureOptions
from stereorig.server.formats.results.layout import COVARIANCE_NAMES


@dataclass(frozen=True, kw_only=True)
class DenseStep:
    """The dense field of one step.

    Attributes
    ----------
    field
        None if there is none.
    reason
        Reason why there is none.
    seconds
        Duration of its measurement.
    """

    field: Field | None
    reason: str | None
    seconds: float

    def entry(self, shown: Field | None, file: str | None) -> dict[str, Any]:
        """Return the entry of the step's summary, for the field as its file has it."""
        if shown is None or shown.dense is None:
            return {"method": METHOD, "file": None, "reason": self.reason}
        valid = shown.valid
        sigma = shown.sigma_mm[valid]
        return {
            "method": METHOD,
            "file": file,
            "reason": None,
            "vectors": int(valid.size),
            "valid": int(valid.sum()),
            **shown.dense.document(),
            "sigma_median_mm": {
                name: float(np.median(sigma[:, k])) if len(sigma) else None
                for k, name in enumerate(COVARIANCE_NAMES[: sigma.shape[1]])
            },
            "compute_s": self.seconds,
        }


@dataclass(eq=False)
class DenseSteps:
    """Measures the dense fields of a sequence.

    Parameters
    ----------
    pair, options
        As the ordinary fields are measured.
    step_px
        Distance of vectors; None: no dense field.
    """

    pair: StereoPair
    options: MeasureOptions
    step_px: int | None

    def __post_init__(self) -> None:
        self._done: dict[int, DenseStep] = {}
        self._shape: tuple[Field, Field] | None = None  # of which ordinary shape, and the dense one

    @property
    def wanted(self) -> bool:
        """True if the steps have dense fields."""
        return self.step_px is not None

    def measure(self, n: int, shape: Field, result: Field, images: Sequence[MeasureImage], grid: PointGrid) -> None:
        """Measure the dense field of a step; a step that can have none has the reason instead.

        Parameters
        ----------
        n
            Number of the step.
        shape, result
            The ordinary shape, and the step's field: the same for the reference.
        images
            The reference's, and of another step its own.
        grid
            The points of the ordinary fields.
        """
        began = time.perf_counter()
        found: Field | None = None
        reason = None
        try:
            found = self._of(shape, result, images, grid)
        except InputError as error:
            reason = error.cause
        self._done[n] = DenseStep(field=found, reason=reason, seconds=round(time.perf_counter() - began, 3))

    def _of(self, shape: Field, result: Field, images: Sequence[MeasureImage], grid: PointGrid) -> Field:
        from stereorig.core.dense.field import dense_motion, dense_shape  # slow to load, and few measurements need it

        assert self.step_px is not None
        if self._shape is None or self._shape[0] is not shape:
            self._shape = shape, dense_shape(self.pair, images[:2], shape, grid, self.options, step_px=self.step_px)
        if not result.has_motion:
            return self._shape[1]
        return dense_motion(self.pair, images, shape, result, self._shape[1], grid, self.options, step_px=self.step_px)

    def take(self, n: int) -> DenseStep | None:
        """Return the dense field of a step, once; None if none was measured."""
        return self._done.pop(n, None)
