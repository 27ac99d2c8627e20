"""Region of interest: the grid of points from a rectangle, a polygon, a mask image, or several of them together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import RegionError
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.settings import SUBSET_PX

if TYPE_CHECKING:
    from stereorig.core.field.region.visibility import Visibility

_MAX_POINTS = 20_000_000


@dataclass(frozen=True, eq=False)
class PointGrid:
    """Points on a regular grid of camera 1's reference image, with the selection that may be measured.

    Attributes
    ----------
    x_px, y_px
        (r, c) columns and rows of the points.
    allowed
        (r, c) True at points inside the region and on the mask's white; the others get the status MASKED.
    spacing_px
        Distance of neighbouring points.
    extent_px
        (x0, y0, x1, y1) of the region given, px.
    cuts
        Cracks and borders of holes, which no subset or neighbour crosses; or None.
    white
        (rows, cols) of camera 1's image, True where the mask is white; None without a mask.
    visibility
        Visible pixels of each point's subset, see :func:`stereorig.core.field.region.find_visible.with_visibility`;
        None before it is computed, and without cuts and mask.
    """

    x_px: Float
    y_px: Float
    allowed: Bool
    spacing_px: float
    extent_px: tuple[float, float, float, float]
    cuts: Cuts | None = None
    white: Bool | None = None
    visibility: Visibility | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of points."""
        return int(self.x_px.shape[0]), int(self.x_px.shape[1])

    @property
    def xy_px(self) -> Float:
        """(r, c, 2) the points."""
        return np.stack([self.x_px, self.y_px], axis=-1)

    @staticmethod
    def rectangle(x0_px: float, y0_px: float, x1_px: float, y1_px: float, *, spacing_px: float) -> PointGrid:
        """Place points at X0 + i step up to X1 inclusive, and likewise in Y.

        Raises
        ------
        RegionError
            ``region_unusable`` for numbers that are not finite, ``region_empty`` for corners out of order.
        """
        _finite("rectangle", [x0_px, y0_px, x1_px, y1_px])
        _step(spacing_px)
        if x1_px < x0_px or y1_px < y0_px:
            raise RegionError(
                f"the rectangle from ({x0_px:g}, {y0_px:g}) to ({x1_px:g}, {y1_px:g}) holds nothing.",
                code="region_empty",
                remedy="Give the upper left corner first, then the lower right one.",
            )
        n_x = int(np.floor((x1_px - x0_px) / spacing_px + 1e-9)) + 1
        n_y = int(np.floor((y1_px - y0_px) / spacing_px + 1e-9)) + 1
        if n_x * n_y > _MAX_POINTS:
            raise RegionError(
                f"the region holds {n_x} x {n_y} points, more than {_MAX_POINTS:,}.",
                code="region_too_large",
                remedy="Give a larger step or a smaller region.",
            )
        # kernels are compiled for doubles: whole numbers would compile them again
        step = float(spacing_px)
        x, y = np.meshgrid(x0_px + step * np.arange(n_x), y0_px + step * np.arange(n_y))
        return PointGrid(x, y, np.ones(x.shape, bool), step, (x0_px, y0_px, x1_px, y1_px))

    @staticmethod
    def polygon(vertices_px: ArrayLike, *, spacing_px: float) -> PointGrid:
        """Place points inside a polygon (n, 2); the grid starts at its bounding box's upper left corner.

        Raises
        ------
        RegionError
            For fewer than three vertices, numbers that are not finite, or no area.
        """
        v = _vertices(vertices_px)
        (x0, y0), (x1, y1) = v.min(axis=0), v.max(axis=0)
        return PointGrid.rectangle(x0, y0, x1, y1, spacing_px=spacing_px).within_polygon(v)

    @staticmethod
    def mask(mask: ArrayLike, *, spacing_px: float) -> PointGrid:
        """Place points on the white of a mask (rows, cols); the grid starts at the white's upper left corner."""
        m = np.asarray(mask).astype(bool)
        if m.ndim != 2 or not m.any():
            raise RegionError(
                f"the mask of shape {m.shape} has no white pixel.",
                code="region_empty",
                remedy="Paint white where points may lie.",
            )
        rows, cols = np.flatnonzero(m.any(axis=1)), np.flatnonzero(m.any(axis=0))
        box = (float(cols[0]), float(rows[0]), float(cols[-1]), float(rows[-1]))
        return PointGrid.rectangle(*box, spacing_px=spacing_px).within_mask(m)

    def only(self, allowed: Bool) -> PointGrid:
        """Return the grid with these points (r, c) allowed alone."""
        return replace(self, allowed=allowed)

    def within_polygon(self, vertices_px: ArrayLike) -> PointGrid:
        """Keep only the points inside a polygon (n, 2), by crossing number; the border's own points count as inside."""
        v = _vertices(vertices_px)
        inside = np.zeros(self.shape, bool)
        border = np.zeros(self.shape, bool)
        for (xa, ya), (xb, yb) in zip(v, np.roll(v, -1, axis=0), strict=True):
            crosses = (ya > self.y_px) != (yb > self.y_px)
            with np.errstate(divide="ignore", invalid="ignore"):
                x_cross = xa + (self.y_px - ya) * (xb - xa) / (yb - ya)
            inside ^= crosses & (self.x_px < x_cross)
            border |= _distance_to_segment(self.x_px, self.y_px, xa, ya, xb, yb) < 1e-9
        return replace(self, allowed=self.allowed & (inside | border))

    def with_cracks(self, lines_px: Iterable[ArrayLike]) -> PointGrid:
        """Add cracks: polylines (n, 2) that no subset or neighbour crosses.

        Raises
        ------
        RegionError
            ``cut_invalid``.
        """
        return self._with_cuts(Cuts(lines_px))

    def without_holes(self, polygons_px: Iterable[ArrayLike]) -> PointGrid:
        """Remove the points inside holes (polygons, (n, 2)); their borders are cuts.

        Raises
        ------
        RegionError
            As :meth:`polygon`.
        """
        grid = self
        for polygon in polygons_px:
            v = _vertices(polygon)
            inside = grid.only(np.ones(grid.shape, bool)).within_polygon(v).allowed
            border = Cuts([np.concatenate([v, v[:1]])])
            grid = replace(grid, allowed=grid.allowed & ~inside)._with_cuts(border)
        return grid

    def _with_cuts(self, more: Cuts) -> PointGrid:
        lines = (*(self.cuts.lines_px if self.cuts else ()), *more.lines_px)
        return replace(self, cuts=Cuts(lines) if lines else None, visibility=None)

    def within_mask(self, mask: ArrayLike) -> PointGrid:
        """Keep only the points whose centre is on the white (non-zero) of a mask the size of camera 1's image.

        Their subsets are cut to the white visible from the centre. Points off the mask's array are left unchanged: they
        are outside the image, and are rejected for that.
        """
        m = np.asarray(mask).astype(bool)
        if m.ndim != 2:
            raise RegionError(f"a mask of shape {m.shape} is not an image.", code="mask_size")
        col, row = np.rint(self.x_px).astype(np.int64), np.rint(self.y_px).astype(np.int64)
        off = (col < 0) | (row < 0) | (col >= m.shape[1]) | (row >= m.shape[0])
        white = m[np.clip(row, 0, m.shape[0] - 1), np.clip(col, 0, m.shape[1] - 1)]
        both = m if self.white is None or self.white.shape != m.shape else m & self.white
        return replace(self, allowed=self.allowed & (white | off), white=both, visibility=None)


def check_region(
    grid: PointGrid, *, image_shape: tuple[int, int], subset_px: int, mask_shape: tuple[int, int] | None = None
) -> Bool:
    """Check a grid against camera 1's image before anything is computed.

    Parameters
    ----------
    grid
        The points.
    image_shape
        Rows and columns of camera 1's image.
    subset_px
        Width of the subset.
    mask_shape
        Shape of the mask that went into the grid, if there was one.

    Returns
    -------
    NDArray
        (r, c) bool, True at allowed points whose subset is inside the image.

    Raises
    ------
    RegionError
        ``subset_invalid``, ``region_outside_image``, ``region_too_small``, ``region_empty``, ``mask_size``,
        ``cut_outside_image``.
    """
    rows, cols = image_shape
    check_subset(subset_px)
    for line in grid.cuts.lines_px if grid.cuts else ():
        off = (line < -0.5).any(axis=1) | (line[:, 0] > cols - 0.5) | (line[:, 1] > rows - 0.5)
        if off.any():
            x, y = line[int(np.argmax(off))]
            raise RegionError(
                f"a crack or a hole's border goes through ({x:g}, {y:g}), outside camera 1's image of "
                f"{cols} x {rows} px.",
                code="cut_outside_image",
                remedy="Draw it in camera 1's reference image.",
            )
    if mask_shape is not None and tuple(mask_shape) != (rows, cols):
        raise RegionError(
            f"the mask is {mask_shape[1]} x {mask_shape[0]} px, camera 1's image {cols} x {rows} px.",
            code="mask_size",
            remedy="Draw the mask over camera 1's reference image.",
        )
    x0, y0, x1, y1 = grid.extent_px
    box = f"({x0:g}, {y0:g}) to ({x1:g}, {y1:g})"
    if x0 < -0.5 or y0 < -0.5 or x1 > cols or y1 > rows:
        raise RegionError(
            f"the region {box} does not lie in camera 1's image of {cols} x {rows} px.",
            code="region_outside_image",
            remedy="Give a region inside camera 1's reference image.",
        )
    if min(x1 - x0, y1 - y0) + 1 < subset_px:
        raise RegionError(
            f"the region {box} is {x1 - x0 + 1:g} x {y1 - y0 + 1:g} px, smaller than one subset of {subset_px} px.",
            code="region_too_small",
            remedy="Give a larger region or a smaller subset.",
        )
    if not grid.allowed.any():
        raise RegionError(
            f"no point of the region {box} at a step of {grid.spacing_px:g} px lies inside it and on the mask's white.",
            code="region_empty",
            remedy="Paint white where points may lie, or give a smaller step.",
        )
    half = subset_px // 2
    fits = (grid.x_px >= half) & (grid.y_px >= half) & (grid.x_px <= cols - 1 - half) & (grid.y_px <= rows - 1 - half)
    if not (fits & grid.allowed).any():
        raise RegionError(
            f"no subset of {subset_px} px about a point of the region {box} lies in camera 1's image of "
            f"{cols} x {rows} px.",
            code="region_too_small",
            remedy="Give a smaller subset, or a region further from the image's border.",
        )
    return np.asarray(fits & grid.allowed)


def check_subset(subset_px: int) -> None:
    """Raise ``subset_invalid`` for an even or tiny subset."""
    if not SUBSET_PX.holds(subset_px):
        raise RegionError(
            f"the subset is {subset_px} px wide; it must be {SUBSET_PX}.",
            code="subset_invalid",
            remedy=f"Give {SUBSET_PX.default}, for example; a subset should hold three speckles across or more.",
        )


def _finite(name: str, values: ArrayLike) -> None:
    if not np.isfinite(np.asarray(values, dtype=np.float64)).all():
        raise RegionError(f"the {name} holds a number that is not finite: {np.asarray(values).tolist()}.")


def _step(spacing_px: float) -> None:
    if not (np.isfinite(spacing_px) and spacing_px >= 1.0):
        raise RegionError(
            f"the step is {spacing_px} px; it must be 1 px or more.",
            code="step_invalid",
            remedy="Give a step between 1 px and the subset's width.",
        )


def _vertices(vertices_px: ArrayLike) -> Float:
    v = np.asarray(vertices_px, dtype=np.float64)
    if v.ndim != 2 or v.shape[1:] != (2,) or len(v) < 3:
        raise RegionError(f"a polygon needs three or more (x, y) vertices, got an array of shape {v.shape}.")
    _finite("polygon", v)
    nxt = np.roll(v, -1, axis=0)
    if abs(0.5 * np.sum(v[:, 0] * nxt[:, 1] - nxt[:, 0] * v[:, 1])) < 1e-9:
        raise RegionError("the polygon has no area.", code="region_empty", remedy="Give its corners in order.")
    return v


def _distance_to_segment(x: Float, y: Float, xa: float, ya: float, xb: float, yb: float) -> Float:
    length2 = (xb - xa) ** 2 + (yb - ya) ** 2
    if length2 == 0.0:
        return np.hypot(x - xa, y - ya)
    t = np.clip(((x - xa) * (xb - xa) + (y - ya) * (yb - ya)) / length2, 0.0, 1.0)
    return np.hypot(x - xa - t * (xb - xa), y - ya - t * (yb - ya))
