"""The grid of points of a region, laid and checked against camera 1's reference image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import RegionError
from stereorig.core.field.region.region import PointGrid, check_region
from stereorig.core.settings import AnalysisSettings, Outline, Region


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


# Closed outlines of a region: rectangle, polygon and circle, as corners and as the points inside.

_CHORD_PX = 0.02
"""Distance of a circle's chords from it, by which its corners are spaced: far less than a subset resolves."""


def outlines_of(region: Region) -> list[Outline]:
    """Return a region's outlines, in any of its forms; none for a mask alone."""
    if region.rectangle is not None or region.polygon is not None:
        return [Outline.model_construct(rectangle=region.rectangle, polygon=region.polygon, circle=None)]
    return list(region.outlines)


def corners_px(outline: Outline) -> Float:
    """Return an outline's corners (n, 2), px; a circle's are on it, so close that no chord is off by a fiftieth px."""
    if outline.polygon is not None:
        return np.asarray(outline.polygon, dtype=np.float64)
    if outline.rectangle is not None:
        x0, y0, x1, y1 = outline.rectangle
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)
    x, y, radius = outline.circle or (np.nan, np.nan, np.nan)
    n = int(np.clip(np.ceil(np.pi / np.sqrt(2.0 * _CHORD_PX / max(radius, 1.0))), 12, 360))
    angle_rad = 2.0 * np.pi * np.arange(n) / n
    return np.stack([x + radius * np.cos(angle_rad), y + radius * np.sin(angle_rad)], axis=-1)


def lay_outlines(outlines: list[Outline], spacing_px: int) -> PointGrid:
    """Place points in the union of outlines; the grid starts at the upper left corner of the box about all of them.

    Raises
    ------
    RegionError
        As :meth:`PointGrid.rectangle` and :meth:`PointGrid.polygon`.
    """
    first = outlines[0]
    if len(outlines) == 1 and first.rectangle is not None:
        return PointGrid.rectangle(*first.rectangle, spacing_px=spacing_px)
    if len(outlines) == 1 and first.polygon is not None:
        return PointGrid.polygon(first.polygon, spacing_px=spacing_px)
    boxes = np.array([_box(outline) for outline in outlines])
    (x0, y0), (x1, y1) = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    grid = PointGrid.rectangle(x0, y0, x1, y1, spacing_px=spacing_px)
    inside = np.zeros(grid.shape, bool)
    for outline in outlines:
        inside |= _inside(outline, grid)
    return grid.only(inside)


def points_inside(outline: Outline, x_px: Float, y_px: Float) -> Bool:
    """Return (r, c) True for the points of a grid inside an outline or on its border."""
    everywhere = np.ones(x_px.shape, bool)
    box = (float(x_px.min()), float(y_px.min()), float(x_px.max()), float(y_px.max()))
    return _inside(outline, PointGrid(x_px, y_px, everywhere, 1.0, box))


def _box(outline: Outline) -> tuple[float, float, float, float]:
    if outline.rectangle is not None:
        x0, y0, x1, y1 = outline.rectangle
        if x1 < x0 or y1 < y0:
            raise RegionError(
                f"the rectangle from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) holds nothing.",
                code="region_empty",
                remedy="Give the upper left corner first, then the lower right one.",
            )
        return x0, y0, x1, y1
    if outline.circle is not None:
        x, y, radius = outline.circle
        return x - radius, y - radius, x + radius, y + radius
    v = corners_px(outline)
    return float(v[:, 0].min()), float(v[:, 1].min()), float(v[:, 0].max()), float(v[:, 1].max())


def _inside(outline: Outline, grid: PointGrid) -> Bool:
    """Return (r, c) True for points inside an outline or on its border."""
    if outline.circle is not None:
        x, y, radius = outline.circle
        return np.asarray(np.hypot(grid.x_px - x, grid.y_px - y) <= radius + 1e-9)
    if outline.rectangle is not None:
        x0, y0, x1, y1 = outline.rectangle
        return np.asarray((grid.x_px >= x0) & (grid.x_px <= x1) & (grid.y_px >= y0) & (grid.y_px <= y1))
    return grid.only(np.ones(grid.shape, bool)).within_polygon(corners_px(outline)).allowed
