"""Offsets across epipolar lines of a step's own images, at points that moved with the specimen.

A motion's fit has one offset a point for the reference and the step together, so that an error of the calibration does
not become motion. A camera that moved between them would show as a third of its offset only: here the step's pair is
matched on its own, at a sample of the points.
"""

from __future__ import annotations

import copy

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.fit import fit_shape
from stereorig.core.matching.slopes import SlopeFilter
from stereorig.core.orientation.matched import MatchedPoints, seen_by_camera2
from stereorig.core.robust import MAD_TO_SIGMA, median, spread_indices
from stereorig.core.status import PointStatus

SAMPLE = 1000
_LEAST = 256
#: of the mean over the points, by noise: a quarter of the smallest smooth errors between two steps
_NOISE_PX = 5e-4
_ALONE = 1.5  # noise of a pair's own offset over that of two pairs together
_LARGE_PIXELS = 8_000_000  # from here on an image's gradients are made for this match alone: 12 bytes a pixel


def step_points(
    pair: StereoPair,
    field: Field,
    image1: MeasureImage,
    image2: MeasureImage,
    options: MeasureOptions,
    slopes: SlopeFilter | None = None,
) -> MatchedPoints | None:
    """Match a step's two images at a sample of its field's points.

    Parameters
    ----------
    pair
        The calibrated cameras.
    field
        As measured, with the matcher's own unknowns.
    image1, image2
        Both cameras' images of the step.
    options
        Options of the measurement.
    slopes
        The reference's filter, which suits a step of the same camera as well as its own: its computation is the larger
        part of an image's gradients. Its own when left out.

    Returns
    -------
    MatchedPoints or None
        None if the field has no unknowns of the matcher, or no point matches.
    """
    if field.starts is None or field.starts.G is None:
        return None
    index = np.flatnonzero(field.valid.ravel())
    if len(index) == 0:
        return None
    index = index[np.unique(spread_indices(len(index), enough_points(field, options.subset_px)))]
    w = field.starts.w.reshape(len(field.x_px.ravel()), -1)[index, :3]
    G = field.starts.G.reshape(len(field.x_px.ravel()), 3, -1)[index][..., :3]
    xy, start = current_plane(pair, w, G)
    half = options.subset_px // 2 + 2
    rows, cols = image1.shape
    with np.errstate(invalid="ignore"):
        inside = (xy >= half).all(axis=1) & (xy[:, 0] <= cols - 1 - half) & (xy[:, 1] <= rows - 1 - half)
    xy, start = xy[inside], start[inside]
    if len(xy) == 0:
        return None
    images = [image.prepared(options.interpolation, None, options.blur) for image in (image1, image2)]
    if slopes is not None or images[0].raw.size > _LARGE_PIXELS:
        images[0] = copy.copy(images[0])
    if slopes is not None:
        # drop gradients that another match may have stored with this image
        vars(images[0]).pop("gradients", None)
        vars(images[0])["slopes"] = slopes
    fit = fit_shape(pair, images[0], images[1], xy, start, options.match_options())
    good = (fit.status == PointStatus.OK) & (fit.zncc.min(axis=1) >= options.min_zncc) & np.isfinite(fit.epipolar_px)
    if not good.any():
        return None
    rays = pair.cam1.rays_cam(xy[good])
    xyz = pair.cam1.sys_from_cam.apply(rays.xyz_mm / fit.w[good, :1])
    return MatchedPoints.of(
        xy[good], seen_by_camera2(pair, rays, xyz, fit.epipolar_px[good]), subset_px=options.subset_px
    )


def enough_points(field: Field, subset_px: int) -> int:
    """Return from how many of a field's points, :data:`SAMPLE` at most, noise is small beside offsets that count."""
    x, offset = field.x_px, field.epipolar_px
    apart = int(np.ceil(subset_px / float(x[0, 1] - x[0, 0]))) if x.shape[1] > 1 else x.shape[1]
    change = (offset[:, apart:] - offset[:, :-apart]).ravel()  # of points that share no pixel, and nearly all else
    change = change[np.isfinite(change)]
    if len(change) < _LEAST:
        return SAMPLE
    noise_px = _ALONE * MAD_TO_SIGMA / np.sqrt(2.0) * median(np.abs(change - median(change)))
    return int(np.clip((noise_px / _NOISE_PX) ** 2, _LEAST, SAMPLE))


def current_plane(pair: StereoPair, w: Float, G: Float) -> tuple[Float, Float]:
    """Return camera 1's images of moved patches, (n, 2) px, and their inverse depths with slopes there, (n, 3).

    Parameters
    ----------
    pair
        The calibrated cameras.
    w, G
        (n, 3) and (n, 3, 3), see :class:`stereorig.core.matching.fit.MotionFit`.
    """
    depth = G[:, 2, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        at = G[:, :2, 0] / depth[:, None]
        now = w[:, 0] / depth
        over = (G[:, :2, 1:] - at[:, :, None] * G[:, 2:, 1:]) / depth[:, None, None]
        slopes = (w[:, 1:] - now[:, None] * G[:, 2, 1:]) / depth[:, None]
    good = np.isfinite(over).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(over))) > 1e-9)
    over[~good] = np.eye(2)
    turned = np.linalg.solve(np.swapaxes(over, 1, 2), slopes[..., None])[..., 0]
    xy = pair.cam1.lens.image_from_normalised(at).xy
    xy[~good] = np.nan
    return xy, np.column_stack([now, turned])
