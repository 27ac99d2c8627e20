"""The measured surface as triangles of neighbouring points, none over a cut, a hole or a failed point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.region.cuts import Cuts, crosses

Indices = NDArray[np.intp]


def triangles_of(
    x_px: Float, y_px: Float, valid: NDArray[np.bool_], cuts: Cuts | None, mask: NDArray[np.bool_] | None = None
) -> Indices:
    """Return (m, 3) triangles between neighbouring valid points; indices into the flattened (r, c) grid.

    Parameters
    ----------
    x_px, y_px, valid
        (r, c) positions in camera 1's reference image, and True at measured points.
    cuts
        Lines over which no triangle reaches.
    mask
        Camera 1's image, False at pixels that no side of a triangle may pass.

    Notes
    -----
    Each quadrilateral of four neighbours gives two; with one corner failed, the triangle of the other three. No side
    meets a cut, and no cut is inside one. They turn as x to the right and y down does: clockwise in the image.
    """
    rows, cols = valid.shape
    index = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = (index[i : rows - 1 + i, j : cols - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    ok = valid.ravel()
    # the other diagonal if one end of the usual one failed
    other = (~ok[b] | ~ok[c]) & ok[a] & ok[d]
    first = np.where(other[:, None], np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    second = np.where(other[:, None], np.stack([a, d, c], 1), np.stack([b, d, c], 1))
    three = np.concatenate([first, second])
    three = three[ok[three].all(axis=1)]
    if not len(three):
        return np.zeros((0, 3), dtype=np.intp)
    xy = np.stack([x_px.ravel(), y_px.ravel()], axis=-1)
    if mask is not None:
        three = three[~_over_black(xy[three], mask)]
    if cuts and len(three):
        corners = xy[three]
        separated = crosses(corners, np.roll(corners, -1, axis=1), cuts).any(axis=1)
        three = three[~(separated | _holds_a_cut(corners, cuts))]
    return np.asarray(three, dtype=np.intp)


def _over_black(corners: Float, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return True if a triangle's (m, 3, 2) side passes a pixel that the mask leaves out; checks every half pixel."""
    sides = np.roll(corners, -1, axis=1) - corners
    steps = max(2, int(np.ceil(2.0 * np.abs(sides).max())) + 1)
    met = np.zeros(len(corners), dtype=bool)
    rows, cols = mask.shape
    for share in np.linspace(0.0, 1.0, steps):
        at = np.rint(corners + share * sides).astype(np.intp)
        x, y = np.clip(at[..., 0], 0, cols - 1), np.clip(at[..., 1], 0, rows - 1)
        met |= ~mask[y, x].all(axis=1)
    return met


def _holds_a_cut(corners: Float, cuts: Cuts) -> NDArray[np.bool_]:
    """Return True if a whole cut is inside a triangle (m, 3, 2): its first point is, and it meets no side."""
    held = np.zeros(len(corners), dtype=bool)
    low, high = corners.min(axis=1), corners.max(axis=1)
    for line in cuts.lines_px:
        point = line[0]
        near = np.flatnonzero(((low <= point) & (point <= high)).all(axis=1))
        if near.size:
            sides = np.roll(corners[near], -1, axis=1) - corners[near]
            to = point - corners[near]
            turn = sides[..., 0] * to[..., 1] - sides[..., 1] * to[..., 0]
            held[near] |= (turn >= 0.0).all(axis=1) | (turn <= 0.0).all(axis=1)
    return held


def turned_as(triangles: Indices, xyz_mm: Float, normals: Float) -> Indices:
    """Turn triangles so that their right-handed normals point as the points' ``normals`` (n, 3) do."""
    p = xyz_mm[triangles]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    against = np.sum(normal * normals[triangles].sum(axis=1), axis=1) < 0.0
    turned = triangles.copy()
    turned[against] = turned[against][:, [0, 2, 1]]
    return turned
