"""What the further steps of a sequence keep of its reference pair at each point, made once from the shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.cameras.stereo import StereoPair
from core.field.points.result import Field
from core.field.region.visibility import Visibility
from core.matching.fit import keep_reference
from core.matching.image import ImageData
from core.matching.options import MatchOptions

MOST_POINTS = 100_000
"""Of more, nothing is kept: it is 0.4 kB a point."""


@dataclass(frozen=True, eq=False)
class KeptReference:
    """What is kept of n points of a regular grid.

    Attributes
    ----------
    xy_px
        (n, 2) the points in camera 1.
    columns, spacing_px
        Of the grid.
    rows
        (n, k) of :func:`core.matching.fit.keep_reference`.
    """

    xy_px: Float
    columns: int
    spacing_px: float
    rows: Float

    @staticmethod
    def of(
        pair: StereoPair,
        images: tuple[ImageData, ImageData],
        shape: Field,
        spacing_px: float,
        options: MatchOptions,
        visibility: Visibility | None,
    ) -> KeptReference | None:
        """Return what is kept of a shape's points.

        Parameters
        ----------
        pair, images
            The cameras and both prepared reference images.
        shape
            With the matcher's own unknowns.
        spacing_px
            Of the grid.
        options
            Of the further steps' matching.
        visibility
            The points' visibility.

        Returns
        -------
        KeptReference or None
            None where that serves nothing: of rigid and of curved patches, whose steps do not start from the plane that
            the shape is, of a shape without unknowns, and of very many points.
        """
        n = shape.x_px.size
        if shape.starts is None or options.patch != "affine" or shape.starts.w.shape[-1] != 3 or n > MOST_POINTS:
            return None
        xy = np.stack([shape.x_px.ravel(), shape.y_px.ravel()], axis=-1)
        known = np.flatnonzero(shape.valid.ravel())
        visible = None if visibility is None else visibility.at(xy[known])
        w, offset = shape.starts.w.reshape(n, 3)[known], shape.epipolar_px.ravel()[known]
        found = keep_reference(pair, *images, xy[known], w, offset, options, visible)
        rows = np.zeros((n, found.shape[1]))
        rows[known] = found
        return KeptReference(xy, shape.x_px.shape[1], spacing_px, rows)

    def at(self, xy_px: Float) -> Float | None:
        """Return the rows of points (m, 2) of the grid; None where one of them is none of its."""
        column, row = np.rint((xy_px - self.xy_px[0]) / self.spacing_px).astype(np.int64).T
        index = row * self.columns + column
        inside = (index >= 0) & (index < len(self.rows))
        if not inside.all() or np.abs(self.xy_px[index] - xy_px).max(initial=0.0) > 1e-6:
            return None
        return np.asarray(np.take(self.rows, index, axis=0))
