"""From a request's region to the grid of points: the same for the check before a job and for the worker."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import RegionError
from core.field.region.region import PointGrid, check_region


def make_grid(settings: Mapping[str, Any], mask: NDArray[np.bool_] | None, image_shape: tuple[int, int]) -> PointGrid:
    """Lay the points of an analysis and check them against camera 1's reference image.

    Parameters
    ----------
    settings
        ``region`` (``rectangle``, ``polygon``, ``cracks``, ``holes``), ``step_px``, ``subset_px`` and
        ``seeds`` as the API takes them.
    mask
        (rows, cols) True where points may lie, or None.
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
    region, step = settings["region"], float(settings["step_px"])
    if region["rectangle"] is not None:
        grid = PointGrid.rectangle(*region["rectangle"], step_px=step)
    elif region["polygon"] is not None:
        grid = PointGrid.polygon(np.asarray(region["polygon"], dtype=np.float64), step_px=step)
    elif mask is not None:
        grid = PointGrid.mask(mask, step_px=step)
    else:
        raise RegionError("The region names no rectangle, no polygon and no mask.", code="region_empty")
    if mask is not None:
        grid = grid.within_mask(mask)
    # analyses from before there were cracks and holes do not name them
    grid = grid.without_holes(region.get("holes") or []).with_cracks(region.get("cracks") or [])
    check_region(grid, image_shape=image_shape, subset_px=settings["subset_px"])
    rows, cols = image_shape
    for x, y in settings["seeds"] or []:
        if not (0.0 <= x <= cols - 1 and 0.0 <= y <= rows - 1):
            raise RegionError(
                f"The seed ({x:g}, {y:g}) lies outside camera 1's image of {cols} x {rows} px.",
                code="seed_outside",
                remedy="Give seeds inside camera 1's reference image.",
            )
    return grid
