"""The images of a motion, warped once along a smooth prediction of the field, and the starts that it predicts.

A step's points share their pixels. Where the field is smooth, each image is interpolated once at the predicted places;
the points' fits then compare subsets of these, and interpolate nothing. The prediction's own curvature is taken off in
them, so a point's result is that of its own fit, up to terms of second order in its distance from the prediction.

Camera 2's reference image shows the same in every step. Its prediction is the smoothed shape, and what the fits compute
of it and of the reference's subsets is kept as long as the reference images are.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.field.points.fitter import Fitter
from stereorig.core.field.points.prediction import predict
from stereorig.core.field.points.scales import depth_per_px, px_per_ray
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.arguments import WarpedImages, empty_memory
from stereorig.core.matching.image import ImageData
from stereorig.core.matching.prewarp import NodeLattice, project_nodes, warp_image

_WIDTHS = (1.0,)
_BEND_REACH = 0.6  # of half a subset: distance of the nodes whose second difference is a subset's curvature


@dataclass(frozen=True, eq=False)
class PredictedPoints:
    """Starts of n points and the images warped along them.

    Attributes
    ----------
    w, G
        (n, 3), (n, 3, 3) the prediction's own patches.
    warped
        The images.
    whole
        (n,) True where a subset lies within the prediction and in all images.
    """

    w: Float
    G: Float
    warped: WarpedImages
    whole: Bool


@dataclass(frozen=True, eq=False)
class _Reference:
    """What is the same in all steps: the shape's prediction at r x c nodes, and camera 2's reference image along it.

    ``w``, ``epipolar_px`` (n,) are the shape that it was made of, ``state`` (r, c, 2, 4) their smoothed values.
    """

    image2: ImageData
    w: Float
    epipolar_px: Float
    subset_px: int
    grid_px: Float
    lattice: NodeLattice
    rays: Float
    state: Float
    seen: Bool
    bends: Float
    values: Float32
    inside: NDArray[np.uint8]
    memory: Float

    def is_of(self, fitter: Fitter, grid: PointGrid, w: Float, epipolar_px: Float) -> bool:
        return (
            self.image2 is fitter.ref2
            and self.subset_px == fitter.options.subset_px
            and np.array_equal(self.grid_px, grid.xy_px)
            and np.array_equal(self.w, w, equal_nan=True)
            and np.array_equal(self.epipolar_px, epipolar_px, equal_nan=True)
        )


_kept: WeakKeyDictionary[ImageData, _Reference] = WeakKeyDictionary()
_kept_lock = threading.Lock()


def warp_to_prediction(
    fitter: Fitter, grid: PointGrid, shape: tuple[Float, Float], w: Float, G: Float, known: Bool
) -> PredictedPoints | None:
    """Smooth a field's unknowns, and warp the images along them; None if no part of the field is smooth.

    Parameters
    ----------
    fitter
        The matcher of a motion.
    grid
        Its points.
    shape
        (n,), (n,) inverse depth and epipolar offset of the shape, the same in all steps.
    w, G
        (n, 3), (n, 3, 3) predicted unknowns.
    known
        (n,) True where all of these are.
    """
    if not known.any() or (of := _reference_of(fitter, grid, *shape)) is None:
        return None
    rows, cols = grid.shape
    subset_px, pair, lattice = fitter.options.subset_px, fitter.pair, of.lattice
    middle = slice(lattice.rim, lattice.rim + rows), slice(lattice.rim, lattice.rim + cols)
    rays = of.rays[middle].reshape(-1, 3)
    # px, as the prediction's limits are
    scale = float(np.nanmedian(px_per_ray(pair, rays[known])[:, 0] / G[known, 2, 0]))
    # the same current positions, about the shape's inverse depths; less the rays, which the lens bends
    moved = (scale * (G[:, :, 0] * (shape[0] / w[:, 0])[:, None] - rays)).reshape(rows, cols, 3)
    smooth = predict(grid.xy_px, moved, known.reshape(rows, cols), grid.cuts, subset_px=subset_px, widths=_WIDTHS)
    state = np.concatenate([of.state[:, :, :1], smooth.nodes / scale, of.state[:, :, 1:]], axis=2)
    nodes, unknowns = project_nodes(pair, of.rays[..., :2], state, lattice)
    seen = of.seen & smooth.seen & _between(np.isfinite(nodes).all(axis=(2, 3)))
    if not seen.any():
        return None
    assert fitter.cur1 is not None
    assert fitter.cur2 is not None
    size, nodes = fitter.ref1.shape, np.nan_to_num(nodes)
    cur1, inside1 = warp_image(fitter.cur1, size, lattice, nodes[:, :, 2:4], seen)
    cur2, inside2 = warp_image(fitter.cur2, size, lattice, nodes[:, :, 4:], seen)
    own = unknowns[middle].reshape(-1, 4, 3)
    bends = np.concatenate([of.bends, _bends(nodes[:, :, 2:, 0], subset_px, lattice)], axis=2)
    bends = bends[middle].reshape(-1, 3, 2, 3)
    whole = np.isfinite(own).all(axis=(1, 2)) & np.isfinite(bends).all(axis=(1, 2, 3))
    inside = of.inside & inside1 & inside2
    return PredictedPoints(
        w=own[:, 0],
        G=own[:, 1:],
        warped=WarpedImages(
            (of.values, cur1, cur2),
            bends,
            epipolar_px=of.state[middle][:, :, 1, 0].ravel(),
            memory=of.memory,
            number=np.arange(rows * cols),
        ),
        whole=whole & _whole(inside, grid.xy_px.reshape(-1, 2), subset_px),
    )


def _reference_of(fitter: Fitter, grid: PointGrid, w: Float, epipolar_px: Float) -> _Reference | None:
    """Return the shape's prediction and camera 2's reference image along it, kept from an earlier step."""
    with _kept_lock:
        kept = _kept.get(fitter.ref1)
    if kept is not None and kept.is_of(fitter, grid, w, epipolar_px):
        return kept
    made = _predict_reference(fitter, grid, w, epipolar_px)
    with _kept_lock:
        if made is not None:
            _kept[fitter.ref1] = made
    return made


def _predict_reference(fitter: Fitter, grid: PointGrid, w: Float, epipolar_px: Float) -> _Reference | None:
    pair, subset_px, xy_px = fitter.pair, fitter.options.subset_px, grid.xy_px
    rows, cols = grid.shape
    known = np.isfinite(w) & np.isfinite(epipolar_px)
    rays = pair.cam1.rays_cam(xy_px.reshape(-1, 2)[known]).xyz_mm
    scale = np.array([1.0 / float(np.nanmedian(depth_per_px(pair, rays, w[known]))), 1.0])
    state = (np.stack([w, epipolar_px], axis=1) * scale).reshape(rows, cols, 2)
    smooth = predict(xy_px, state, known.reshape(rows, cols), grid.cuts, subset_px=subset_px, widths=_WIDTHS)
    x0, y0 = float(xy_px[0, 0, 0]), float(xy_px[0, 0, 1])
    lattice = NodeLattice(x0, y0, float(grid.spacing_px), smooth.rim)
    x, y = (
        start + lattice.spacing * np.arange(-smooth.rim, count + smooth.rim)
        for start, count in ((x0, cols), (y0, rows))
    )
    everywhere = pair.cam1.rays_cam(np.stack(np.meshgrid(x, y), axis=-1)).xyz_mm
    of_shape = smooth.nodes / scale[:, None]
    still = np.zeros((*of_shape.shape[:2], 3, 4))
    nodes, _ = project_nodes(
        pair, everywhere[..., :2], np.concatenate([of_shape[:, :, :1], still, of_shape[:, :, 1:]], axis=2), lattice
    )
    seen = smooth.seen & _between(np.isfinite(nodes[:, :, :2]).all(axis=(2, 3)))
    if not seen.any():
        return None
    values, inside = warp_image(fitter.ref2, fitter.ref1.shape, lattice, np.nan_to_num(nodes[:, :, :2]), seen)
    return _Reference(
        image2=fitter.ref2,
        w=np.array(w),
        epipolar_px=np.array(epipolar_px),
        subset_px=subset_px,
        grid_px=xy_px,
        lattice=lattice,
        rays=everywhere,
        state=of_shape,
        seen=seen,
        bends=_bends(nodes[:, :, :2, 0], subset_px, lattice),
        values=values,
        inside=inside,
        memory=empty_memory(rows * cols),
    )


def _between(nodes: Any) -> Bool:
    """Return (r - 1, c - 1) True between four of the nodes (r, c)."""
    return np.asarray(nodes[1:, 1:] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[:-1, :-1])


def _bends(positions_px: Float, subset_px: int, lattice: NodeLattice) -> Float:
    """Return (r, c, m, 3) the second-order terms x^2, x y, y^2 about nodes of positions (r, c, m).

    Offsets are over half the subset's width. They are differences of nodes, NaN at the rim.
    """
    half = 0.5 * (subset_px - 1) / lattice.spacing
    step = max(round(_BEND_REACH * half), 1)
    out = np.full((*positions_px.shape, 3), np.nan)
    if min(positions_px.shape[:2]) <= 2 * step:
        return out
    mid, low, high = slice(step, -step), slice(None, -2 * step), slice(2 * step, None)
    p, per = positions_px, (half / step) ** 2
    out[mid, mid, :, 0] = 0.5 * per * (p[mid, high] - 2.0 * p[mid, mid] + p[mid, low])
    out[mid, mid, :, 1] = 0.25 * per * (p[high, high] - p[high, low] - p[low, high] + p[low, low])
    out[mid, mid, :, 2] = 0.5 * per * (p[high, mid] - 2.0 * p[mid, mid] + p[low, mid])
    return out


def _whole(inside: NDArray[np.uint8], xy_px: Float, subset_px: int) -> Bool:
    """Return (n,) True where all pixels of the subset about a point are ``inside`` (rows, cols)."""
    eroded = cv2.erode(inside, np.ones((subset_px, subset_px), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    half = 0.5 * (subset_px - 1)
    middle = np.floor(xy_px - half + 0.5).astype(int) + subset_px // 2
    rows, cols = inside.shape
    at = (middle >= 0).all(axis=1) & (middle[:, 0] < cols) & (middle[:, 1] < rows)
    out = np.zeros(len(xy_px), bool)
    out[at] = eroded[middle[at, 1], middle[at, 0]] > 0
    return out
