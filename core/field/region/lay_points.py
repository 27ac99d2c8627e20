"""The grid of points of a region, laid and checked against camera 1's reference image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import RegionError
from stereorig.core.field.region.outlines import lay_outlines, outlines_of
from stereorig.core.field.region.region import PointGrid, check_region
from stereorig.core.settings import AnalysisSettings, Region


def make_grid(settings: AnalysisSettings, mask: NDArray[np.bool_] | None, image_shape: tuple[int, int]) -> PointGrid:
    """Place the points of an analysis and check them against camera 1's reference image.

    Parameters
    ----------
    settings
        Settings of the analysis.
    mask
        (rows, cols) True at allowed pixels, or None.
    image_shape
        Rows and columns of camera 1's image.

    Raises
    ------
    RegionError
        ``region_empty``, ``region_outside_image``, ``region_too_small``, ``mask_size``, ``seed_outside``,
        ``cut_invalid``, ``cut_outside_image``.
    """
    if mask is not None and mask.shape != image_shape:
        raise RegionError(
            f"The mask is {mask.shape[1]} x {mask.shape[0]} px, camera 1's image {image_shape[1]} x "
            f"{image_shape[0]} px.",
            code="mask_size",
            remedy="Draw the mask over camera 1's reference image.",
        )
    grid = lay_points(settings.region, settings.spacing_px, mask)
    check_region(grid, image_shape=image_shape, subset_px=settings.subset_px)
    rows, cols = image_shape
    for x, y in settings.seeds or []:
        if not (0.0 <= x <= cols - 1 and 0.0 <= y <= rows - 1):
            raise RegionError(
                f"The seed ({x:g}, {y:g}) lies outside camera 1's image of {cols} x {rows} px.",
                code="seed_outside",
                remedy="Give seeds inside camera 1's reference image.",
            )
    return grid


def lay_points(region: Region, spacing_px: int, mask: NDArray[np.bool_] | None) -> PointGrid:
    """Place the points of a region; points on a mask's black or in holes are not allowed.

    Raises
    ------
    RegionError
        ``region_empty``, ``cut_invalid``.
    """
    outlines = outlines_of(region)
    if outlines:
        grid = lay_outlines(outlines, spacing_px)
    elif mask is not None:
        grid = PointGrid.mask(mask, spacing_px=spacing_px)
    else:
        raise RegionError("The region names no outline and no mask.", code="region_empty")
    if mask is not None:
        grid = grid.within_mask(mask)
    return grid.without_holes(region.holes).with_cracks(region.cracks)
