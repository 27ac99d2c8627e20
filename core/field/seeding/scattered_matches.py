"""Scattered shape and motion from feature matches, filtered by the cameras' geometry, and start values from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError
from stereorig.core.field.points.features import Box, Features, match
from stereorig.core.field.points.images import MeasureImage, features_of
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.seeding.local_fit import AreSeparated, consistent, robust_local_fits
from stereorig.core.field.seeding.search_region import scales
from stereorig.core.field.seeding.stretched import stretched_features, stretches

EPIPOLAR_PX = 1.5
"""Distance from the epipolar line up to which a feature match can be right, on images of up to half their size."""
_DEPTH_TOLERANCE_PX = 1.5
_MOTION_TOLERANCE_PX = 2.0
_MIN_MATCHES = 12
_MIN_SWAP_MATCHES = 25


@dataclass(frozen=True, eq=False)
class ScatteredShape:
    """Matches between camera 1 and camera 2 that fit the epipolar geometry and their neighbours.

    Attributes
    ----------
    xy_px
        (n, 2) in camera 1.
    w0
        (n,) inverse depth, 1/mm.
    scale
        Factor by which the images were reduced when the features were found.
    """

    xy_px: Float
    w0: Float
    scale: int = 1

    @staticmethod
    def empty() -> ScatteredShape:
        """Return no matches."""
        return ScatteredShape(np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class ScatteredMotion:
    """Matches between camera 1's reference and current images that agree with their neighbours; (n, 2) px each."""

    xy_px: Float
    xy_current_px: Float
    scale: int = 1


def scattered_shape(pair: StereoPair, features1: Features, features2: Features) -> ScatteredShape:
    """Match camera 1 with camera 2 and keep the matches that agree with the geometry and their neighbours.

    Raises
    ------
    ImageError
        ``cameras_swapped`` if the matches fit the cameras with exchanged roles and not as given.
    """
    pairs = match(features1, features2)
    xy1, xy2 = features1.xy_px[pairs[:, 0]], features2.xy_px[pairs[:, 1]]
    scale = max(features1.scale, features2.scale)
    limit = EPIPOLAR_PX * _looser(scale)
    near = _on_line(pair, xy1, xy2, limit)
    refuse_swapped(pair, xy1, xy2, near, limit_px=limit)
    xy1, xy2 = xy1[near], xy2[near]
    if len(xy1) == 0:
        return ScatteredShape.empty()
    points = pair.triangulate(xy1, xy2)
    depth = pair.cam1.cam_from_sys.apply(points.xyz_mm)[:, 2]
    depth2 = pair.cam2.cam_from_sys.apply(points.xyz_mm)[:, 2]
    with np.errstate(invalid="ignore"):
        front = points.valid & (depth > 0.0) & (depth2 > 0.0)
    xy1, w0 = xy1[front], 1.0 / depth[front]
    if len(xy1) < _MIN_MATCHES:
        return ScatteredShape(xy1[:0], w0[:0])
    tolerance = _depth_tolerance(pair, xy1, w0, scale)
    right = consistent(xy1, w0[:, None], tolerance=2.0 * tolerance)
    return ScatteredShape(xy1[right], w0[right], scale)


def scattered_motion(features_ref: Features, current_features: Features) -> ScatteredMotion:
    """Match one camera's reference and current images and keep the matches that agree with their neighbours."""
    pairs = match(features_ref, current_features)
    xy, now = features_ref.xy_px[pairs[:, 0]], current_features.xy_px[pairs[:, 1]]
    if len(xy) < _MIN_MATCHES:
        return ScatteredMotion(xy[:0], now[:0])
    scale = max(features_ref.scale, current_features.scale)
    right = consistent(xy, now, tolerance=2.0 * _MOTION_TOLERANCE_PX * _looser(scale))
    return ScatteredMotion(xy[right], now[right], scale)


def stretched_motion(image: NDArray[Any], box: Box, current_features: Features, scale: int) -> ScatteredMotion:
    """Match stretched copies of camera 1's reference image with its current one; the copy with most matches counts."""
    tries = [
        scattered_motion(stretched_features(image, box, stretch, scale=scale), current_features)
        for stretch in stretches()
    ]
    return max(tries, key=lambda motion: len(motion.xy_px))


def _looser(scale: int) -> float:
    """Factor of the standard deviation of features found on a ``scale`` times smaller image."""
    return max(1.0, scale / 2.0)


def _depth_tolerance(pair: StereoPair, xy1: Float, w0: Float, scale: int) -> float:
    per_px = float(np.median(depth_per_px(pair, pair.cam1.rays_cam(xy1).xyz_mm, w0)))
    return _DEPTH_TOLERANCE_PX * _looser(scale) * per_px


def shape_starts(
    pair: StereoPair, shape: ScatteredShape, xy_px: Float, are_separated: AreSeparated | None = None
) -> Starts:
    """Return ``w`` (n, 3) at positions ``xy_px`` (n, 2) from the matches near them; NaN if these do not agree.

    ``are_separated``: see :func:`stereorig.core.field.seeding.local_fit.robust_local_fits`.
    """
    w = np.full((len(xy_px), 3), np.nan)
    if len(shape.xy_px) < 4 or len(xy_px) == 0:
        return Starts(w)
    tolerance = _depth_tolerance(pair, shape.xy_px, shape.w0, shape.scale)
    fits = robust_local_fits(xy_px, shape.xy_px, shape.w0[:, None], tolerance=tolerance, are_separated=are_separated)
    centre = pair.cam1.rays_cam(xy_px).xyz_mm
    per_norm = pair.cam1.lens.image_jacobian(centre[:, :2])
    w[:, 0] = fits.value[:, 0]
    w[:, 1:] = np.einsum("nj,nji->ni", fits.slope[:, 0], per_norm)  # d w / d px times d px / d normalised
    return Starts(w)


def motion_starts(
    pair: StereoPair,
    w: Float,
    motion: ScatteredMotion,
    current_shape: ScatteredShape,
    xy_px: Float,
    are_separated: AreSeparated | None = None,
) -> Starts:
    """Return starts at positions ``xy_px`` with known shape ``w`` (n, 3), from matches in time and between cameras.

    ``are_separated`` as in :func:`shape_starts`, in the reference image.
    """
    G = np.full((len(xy_px), 3, 3), np.nan)
    if len(motion.xy_px) < 4 or len(current_shape.xy_px) < 4 or len(xy_px) == 0:
        return Starts(w, G)
    tolerance = _MOTION_TOLERANCE_PX * _looser(motion.scale)
    fits = robust_local_fits(
        xy_px, motion.xy_px, motion.xy_current_px, tolerance=tolerance, are_separated=are_separated
    )
    known = np.isfinite(fits.value).all(axis=1)
    if known.any():
        w_current = shape_starts(pair, current_shape, fits.value[known]).w
        G[known] = combine(pair, w[known], xy_px[known], fits.value[known], fits.slope[known], w_current)
    return Starts(w, G)


def combine(
    pair: StereoPair, w: Float, xy_px: Float, xy_current_px: Float, affine_px: Float, w_current: Float
) -> Float:
    """Return ``G`` (n, 3, 3) from the reference shape, the patch's current position in camera 1, and the shape there.

    Parameters
    ----------
    pair
        The calibrated cameras.
    w
        (n, 3) reference shape.
    xy_px, xy_current_px
        (n, 2) the point in camera 1's reference and current images.
    affine_px
        (n, 2, 2) derivative of camera 1's current image over its reference image.
    w_current
        (n, 3) current shape about ``xy_current_px``.
    """
    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    now = pair.cam1.rays_cam(xy_current_px).xyz_mm
    J = pair.cam1.lens.image_jacobian(ray[:, :2])
    J_current = pair.cam1.lens.image_jacobian(now[:, :2])
    usable = np.isfinite(J_current).all(axis=(1, 2)) & np.isfinite(affine_px).all(axis=(1, 2))
    A = np.full_like(J, np.nan)
    A[usable] = np.linalg.solve(J_current[usable], affine_px[usable] @ J[usable])
    # the current point is (now + A X, 1) / w_now(A X); G (1, X, Y) is w(X, Y) times it, to first order
    G = np.empty((len(w), 3, 3))
    G[:, :, 0] = (w[:, :1] / w_current[:, :1]) * now
    for j in range(2):
        slope = np.einsum("ni,ni->n", w_current[:, 1:], A[:, :, j])
        G[:, :, 1 + j] = now * (w[:, 1 + j] / w_current[:, 0] - w[:, 0] * slope / w_current[:, 0] ** 2)[:, None]
        G[:, :2, 1 + j] += A[:, :, j] * (w[:, 0] / w_current[:, 0])[:, None]
    return G


def refuse_swapped(pair: StereoPair, xy1: Float, xy2: Float, near: Bool, *, limit_px: float = EPIPOLAR_PX) -> None:
    """Raise ``cameras_swapped`` if matches (n, 2) fit the cameras clearly better with exchanged roles."""
    n = len(xy1)
    if n < _MIN_SWAP_MATCHES or near.mean() > 0.6:
        return
    swapped = _on_line(pair, xy2, xy1, limit_px)
    if swapped.mean() > 0.7 and swapped.sum() > 1.5 * near.sum():
        raise ImageError(
            f"of {n} matches between the two images {near.sum()} fit the calibration as given, "
            f"{swapped.sum()} fit it with the cameras exchanged.",
            code="cameras_swapped",
            remedy="Give camera 1's images as camera 1 and camera 2's as camera 2.",
            matches=n,
            as_given=int(near.sum()),
            exchanged=int(swapped.sum()),
        )


def _on_line(pair: StereoPair, xy1: Float, xy2: Float, limit_px: float) -> Bool:
    if len(xy1) == 0:
        return np.zeros(0, bool)
    ray1, ray2 = pair.cam1.rays_cam(xy1), pair.cam2.rays_cam(xy2)
    both = ray1.valid & ray2.valid
    near = np.zeros(len(xy1), bool)
    if both.any():
        with np.errstate(invalid="ignore"):
            near[both] = np.abs(pair.epipolar_residual_px(xy1[both], xy2[both])) < limit_px
    return near


# Scale of camera 1's image where the surface is, before anything is measured: from feature matches of a pair.


@dataclass(frozen=True)
class ImageScale:
    """Scale of camera 1's image at the surface.

    Attributes
    ----------
    mm_per_px
        Across the line of sight, at the median depth of the matches: a slanted surface is stretched by 1 / cos(slant).
    distance_mm
        That depth, along camera 1's optical axis.
    matches
        Matches with camera 2 that it comes from.
    """

    mm_per_px: float
    distance_mm: float
    matches: int


def image_scale(pair: StereoPair, image1: MeasureImage, image2: MeasureImage) -> ImageScale | None:
    """Return the scale of camera 1's image at the surface that both cameras see; None with too few matches.

    Raises
    ------
    ImageError
        ``cameras_swapped``.
    """
    (rows, cols), (rows2, cols2) = image1.shape, image2.shape
    boxes = (0, 0, cols, rows), (0, 0, cols2, rows2)
    scale = scales(boxes, (image1.shape, image2.shape))[0]
    shape = scattered_shape(pair, *features_of([(image1, boxes[0]), (image2, boxes[1])], scale))
    if len(shape.xy_px) < _MIN_MATCHES:
        return None
    depth_mm = float(1.0 / np.median(shape.w0))
    x, y = np.median(shape.xy_px, axis=0)
    around = np.array([[x - 0.5, y], [x + 0.5, y], [x, y - 0.5], [x, y + 0.5]])
    at = pair.cam1.back_project_at_depth(around, np.full(4, depth_mm)).xyz_mm
    sides = np.linalg.norm(at[[1, 3]] - at[[0, 2]], axis=1)
    return ImageScale(float(np.sqrt(sides[0] * sides[1])), depth_mm, len(shape.xy_px))
