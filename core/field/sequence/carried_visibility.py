"""Visibility at a later reference: the first reference's visibility, moved with the surface.

A crack opens and turns, and its lips separate: lines drawn at the first reference do not show their later places. So
each pixel of a segment's subset is taken back to the first reference through the point's own motion, and is visible if
it is visible there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.find_visible import MARGIN_PX, visible_patches
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.matching.arguments import VisiblePixels

_MAX_WIDTH_RATIO = 4  # times a subset: width that a segment's subset may cover in the first reference
_AT_ONCE = 512


@dataclass(frozen=True, eq=False)
class SegmentVisibility(Visibility):
    """Visibility of n points in a later image.

    Attributes
    ----------
    first
        The same at the first reference.
    position_px, back
        (m, 2), (m, 2, 2) of the points that the segment has: positions in the later image, px, and the derivative of
        the first reference's image over the later one.
    first_px
        (m, 2) their positions at the first reference, px.
    """

    first: Visibility
    position_px: Float
    back: Float
    first_px: Float

    def at(self, xy_px: Float) -> VisiblePixels:
        """Return the visible pixels of points (m, 2), given by the pixels that their subsets are centred on.

        Raises
        ------
        ValueError
            If a position is not one of the segment's pixels.
        """
        keys = _keys(self.xy_px)
        order = np.argsort(keys, kind="stable")
        wanted = _keys(xy_px)
        index = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
        if (keys[index] != wanted).any():
            raise ValueError("a position that is not a pixel of the segment")
        return VisiblePixels(self.visible.patches, self.visible.of_point[index])

    def are_separated(self, a_px: Float, b_px: Float) -> Bool:
        """Return (n,) True if a cut or black is between positions a and b (n, 2) of the later image."""
        return self.first.are_separated(self._at_first(a_px), self._at_first(b_px))

    def _at_first(self, xy_px: Float) -> Float:
        """Take positions (n, 2) back to the first reference with the nearest point."""
        nearest = np.asarray(cKDTree(self.position_px).query(xy_px)[1])
        away = np.einsum("nij,nj->ni", self.back[nearest], xy_px - self.position_px[nearest])
        return np.asarray(self.first_px[nearest] + away)


def _keys(xy_px: Float) -> NDArray[np.int64]:
    x, y = np.rint(xy_px).astype(np.int64).T
    return np.asarray(y * 1_000_003 + x)


def carry_visibility(
    first: Visibility, segment_grid: PointGrid, grid: PointGrid, position_px: Float, slopes_px: Float
) -> SegmentVisibility:
    """Return the visibility at a segment's reference.

    Parameters
    ----------
    first
        Visibility at the first reference.
    segment_grid, grid
        The segment's pixels and the first reference's points, (r, c) both.
    position_px, slopes_px
        (n, 2) px, positions of the points in camera 1's later image; (n, 2, 2) derivative of that image over the first.
    """
    subset_px = first.subset_px
    has = np.flatnonzero(segment_grid.allowed)
    back = np.full(slopes_px.shape, np.nan)
    back[has] = np.linalg.inv(slopes_px[has])
    pixel, xy = segment_grid.xy_px.reshape(-1, 2), grid.xy_px.reshape(-1, 2)
    reach = np.abs(back[has]).sum(axis=2).max() if len(has) else 1.0
    wide = 2 * int(np.ceil(0.5 * subset_px * min(max(float(reach), 1.0), _MAX_WIDTH_RATIO))) + 3
    margin = MARGIN_PX * max(1.0, float(np.median(np.linalg.norm(back[has], 2, axis=(1, 2)))) if len(has) else 1.0)
    n = len(pixel)
    share, of_point = np.ones(n), np.full(n, -1, np.int32)
    kept: list[NDArray[np.uint8]] = []
    offsets = np.arange(subset_px) - subset_px // 2
    v, u = (a.ravel() for a in np.meshgrid(offsets, offsets, indexing="ij"))
    square = np.stack([u, v], axis=-1).astype(np.float64)
    for index, seen in visible_patches(grid, has, wide, margin, _AT_ONCE):
        d = square + (pixel[index] - position_px[index])[:, None]
        at = xy[index][:, None] + np.einsum("nij,nkj->nki", back[index], d)
        corner = np.floor(xy[index] - 0.5 * (wide - 1) + 0.5)
        col, row = np.moveaxis(np.floor(at + 0.5) - corner[:, None], -1, 0).astype(np.int64)
        inside = (col >= 0) & (row >= 0) & (col < wide) & (row < wide)
        k = np.arange(len(index))[:, None]
        found = np.where(inside, seen[k, np.clip(row, 0, wide - 1), np.clip(col, 0, wide - 1)], 0)
        counts = found.sum(axis=1)
        share[index] = counts / float(subset_px**2)
        cut = counts < subset_px**2
        of_point[index[cut]] = sum(map(len, kept)) + np.arange(int(cut.sum()), dtype=np.int32)
        kept.append(found[cut].reshape(-1, subset_px, subset_px).astype(np.uint8))
    patches = np.concatenate(kept) if kept else np.zeros((0, subset_px, subset_px), np.uint8)
    return SegmentVisibility(
        xy_px=pixel,
        shape=segment_grid.shape,
        spacing_px=segment_grid.spacing_px,
        pieces_px=first.pieces_px,
        white=first.white,
        visible=VisiblePixels(patches, of_point),
        share=share,
        separated=first.separated,
        first=first,
        position_px=position_px[has],
        back=back[has],
        first_px=xy[has],
    )
