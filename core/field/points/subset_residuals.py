"""Residual images of fitted subsets: camera 1's reference minus each other image mapped onto it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.lens import LensModel
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.matching.image import PAD, ImageData

_NODES = np.array([-1.0, 0.0, 1.0])


class SubsetResiduals(NamedTuple):
    """Residuals of m subsets in one comparison.

    Attributes
    ----------
    residual
        (m, s, s) grey levels of camera 1's reference, less the other image's at the reference's gain and offset.
    along, across
        (m, s, s) change of the residual a px of shift in the compared image: of camera 2 along and across the epipolar
        line, of camera 1 along x and y.
    reference
        (m, s, s) grey levels of the reference about their mean.
    """

    residual: Float
    along: Float
    across: Float
    reference: Float


def subset_residuals(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, comparisons: slice = slice(-2, None)
) -> tuple[list[SubsetResiduals], Bool]:
    """Return the residuals of the points ``index`` in each comparison, and (m, s, s) True where a pixel counts.

    Parameters
    ----------
    fitter, points
        The matcher, and its points with their results.
    index
        (m,) points that have results.
    xy_px
        (n, 2) px of camera 1, of all points.
    comparisons
        Comparisons to return: by default all of a shape, and only those in time of a motion.
    """
    pair, half = fitter.pair, fitter.options.subset_px // 2
    at, w = xy_px[index], points.w[index]
    middle = np.round(at)
    # the views are smooth over a subset: exact at three by three nodes, of second order between them
    node = half * np.stack(np.meshgrid(_NODES, _NODES), axis=-1).reshape(-1, 2)
    ray = pair.cam1.rays_cam(middle[:, None] + node).xyz_mm
    offset = ray[..., :2] - pair.cam1.rays_cam(at).xyz_mm[:, None, :2]
    terms = _monomials(offset, w.shape[1])
    inverse_depth = np.einsum("mpt,mt->mp", terms, w)[..., None]
    pose, moved = pair.cam2_from_cam1, _epipolar_moves(pair, at, w[:, 0])
    shift = points.epipolar_px[index, None] * moved[1]
    views: list[tuple[ImageData, LensModel, Float, bool]] = [
        (fitter.ref2, pair.cam2.lens, pose.apply(ray / inverse_depth), True)
    ]
    if fitter.cur1 is not None and fitter.cur2 is not None:
        now = np.einsum("mct,mpt->mpc", points.G[index], terms) / inverse_depth
        views += [(fitter.cur1, pair.cam1.lens, now, False), (fitter.cur2, pair.cam2.lens, pose.apply(now), True)]
    visible = subset_visible(fitter, at)
    rows, columns = np.mgrid[: 2 * half + 1, : 2 * half + 1] - half
    y, x = (middle[:, None, None, k].astype(np.intp) + offsets for k, offsets in ((1, rows), (0, columns)))
    grey = fitter.ref1.pixels[y, x].astype(np.float64)
    gradient = np.stack([g[y, x].astype(np.float64) for g in fitter.ref1.gradients], axis=-1)
    between = _between(half)
    out = []
    for image, lens, p, second in views[comparisons]:
        px = lens.image_from_normalised(p[..., :2] / p[..., 2:]).xy
        if second:
            px = px + shift[:, None]
        step = 1.0 / (2.0 * half)
        affine = np.stack([step * (px[:, 5] - px[:, 3]), step * (px[:, 7] - px[:, 1])], axis=-1)
        to_reference = np.linalg.inv(affine)
        directions = np.stack(moved, axis=-1) if second else np.broadcast_to(np.eye(2), affine.shape)
        per_px = gradient @ (to_reference @ directions)[:, None]
        out.append(_laid_on(grey, _shown(image, between @ px, grey.shape), per_px, visible))
    return out, visible


def _monomials(offset: Float, terms: int) -> Float:
    x, y = offset[..., 0], offset[..., 1]
    all_terms = [np.ones_like(x), x, y, x * x, x * y, y * y]
    return np.stack(all_terms[:terms], axis=-1)


def _epipolar_moves(pair: StereoPair, xy_px: Float, w0: Float) -> tuple[Float, Float]:
    """Unit vectors (m, 2), (m, 2) of camera 2's image along the epipolar line, and across it where offsets count up."""
    pose, ray = pair.cam2_from_cam1, pair.cam1.rays_cam(xy_px).xyz_mm
    t, q = pose.translation_mm, ray @ pose.rotation.T
    seen = q + w0[:, None] * t
    u = seen[:, :2] / seen[:, 2:]
    J = pair.cam2.lens.image_jacobian(u)
    along = (J @ (t[:2] - u * t[2])[..., None])[..., 0]
    line = np.cross(np.broadcast_to(t, q.shape), q)[:, :2]
    across = np.linalg.solve(np.swapaxes(J, -1, -2), line[..., None])[..., 0]
    return _unit(along), _unit(across)


def _unit(vectors: Any) -> Float:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30))


def subset_visible(fitter: Fitter, at: Float) -> Bool:
    """Return (m, s, s) True where a pixel of the subsets at points (m, 2) counts."""
    width = fitter.options.subset_px // 2 * 2 + 1
    out = np.ones((len(at), width, width), bool)
    if fitter.visibility is not None:
        part = fitter.visibility.at(at)
        some = part.of_point >= 0
        out[some] = part.patches[part.of_point[some]] > 0
    return out


def _between(half: int) -> Float:
    """(s s, 9) values at the pixels of a subset from those at its nodes."""
    u = np.arange(-half, half + 1) / half
    one = np.stack([0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)], axis=-1)
    return np.asarray(np.einsum("ya,xb->yxab", one, one).reshape(len(u) ** 2, 9))


def _shown(image: ImageData, px: Float, shape: tuple[int, ...]) -> Float:
    places = np.stack([px[..., 1].ravel() + PAD, px[..., 0].ravel() + PAD])
    order: Any = image.order
    grey = np.empty(places.shape[1])
    ndimage.map_coordinates(image.coefficients, places, output=grey, order=order, prefilter=False, mode="nearest")
    return grey.reshape(shape)


def _laid_on(grey: Float, shown: Float, per_px: Float, visible: Bool) -> SubsetResiduals:
    counts = visible.sum(axis=(1, 2))[:, None, None]

    def centred(values: Float) -> Float:
        return np.asarray(values - (values * visible).sum(axis=(1, 2), keepdims=True) / counts)

    f, g = centred(grey), centred(shown)
    gain = (f * g * visible).sum(axis=(1, 2)) / np.maximum((g * g * visible).sum(axis=(1, 2)), 1e-12)
    return SubsetResiduals(f - gain[:, None, None] * g, per_px[..., 0], per_px[..., 1], f)
