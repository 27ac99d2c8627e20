"""Steps measured anew with another subset, from the images and the calibration that the results were made from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.status import PointStatus
from stereorig.server.evaluations.resolution.origin import Origin

_MOST = 40_000  # points that are measured; of more, those about the middle


class MeasuredAnew:
    """Steps of the results, measured with other subsets at the same points.

    Parameters
    ----------
    origin
        Images and calibration.
    like
        A field of the results: its points are measured.
    """

    def __init__(self, origin: Origin, like: Field, spacing_px: float) -> None:
        self._origin = origin
        wanted = like.status != PointStatus.MASKED
        rows, cols = (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
        share = min(1.0, float(np.sqrt(_MOST / (len(rows) * len(cols)))))
        r, c = (_middle(one, share) for one in (rows, cols))
        x, y = like.x_px[r, c], like.y_px[r, c]
        grid = PointGrid.rectangle(*(float(v) for v in (x[0, 0], y[0, 0], x[-1, -1], y[-1, -1])), spacing_px=spacing_px)
        self._grid = replace(grid, allowed=grid.allowed & wanted[r, c], cuts=like.cuts)
        self._pair = ReferencePair(origin.calibration.pair, *origin.reference)

    def fields(self, steps: list[int], subset_px: int) -> list[Field]:
        """Return the fields of steps with a subset."""
        settings = self._origin.settings.model_copy(update={"subset_px": subset_px})
        options = MeasureOptions.of(settings)
        shape = self._pair.shape(self._grid, options)
        return [self._pair.motion(*self._origin.images(n), self._grid, options, shape=shape) for n in steps]


def _middle(of: np.ndarray, share: float) -> slice:
    cut = int(np.floor(0.5 * (1.0 - share) * len(of)))
    return slice(int(of[cut]), int(of[len(of) - 1 - cut]) + 1)
