"""Points near the images' edges, where a Gaussian prefilter lacks neighbours and mirrors the pixels that it has."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import RegionError
from stereorig.core.field.checks.unreached import leaves_an_image
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.blur import Blur
from stereorig.core.status import PointStatus


def clear_of_edges(fits_image: Bool, grid: PointGrid, shape: tuple[int, int], subset_px: int, blur: Blur) -> Bool:
    """Return (r, c) True where a subset holds only pixels of camera 1's image that were blurred with true neighbours.

    Raises
    ------
    RegionError
        ``region_too_small`` if no point is left.
    """
    margin = subset_px // 2 + blur.edge_px
    rows, cols = shape
    x, y = grid.x_px, grid.y_px
    clear = fits_image & (x >= margin) & (y >= margin) & (x <= cols - 1 - margin) & (y <= rows - 1 - margin)
    if not clear.any():
        raise RegionError(
            f"all points lie nearer than {margin} px to the border of camera 1's image, where the prefilter of "
            f"{blur.sd_px:g} px has no neighbours.",
            code="region_too_small",
            remedy="Give a region further from the image's border, a smaller subset or a smaller prefilter.",
        )
    return np.asarray(clear)


def reject_near_edges(fitter: Fitter, points: PointFits, xy_px: Float, blur: Blur) -> None:
    """Reject points, OUTSIDE_IMAGE, with a patch so near to an image's border that the blur lacks neighbours."""
    ok = np.flatnonzero(points.ok)
    off = leaves_an_image(fitter, xy_px[ok], xy_px[ok], points.take(ok), margin_px=blur.edge_px)
    rejected = np.zeros(len(points.status), bool)
    rejected[ok[off]] = True
    points.reject(rejected, PointStatus.OUTSIDE_IMAGE)
