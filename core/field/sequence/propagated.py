"""Propagation of errors from one reference segment of a sequence to the next.

The noise of the image in which one segment ends and the next begins moves the point one way, then the other, and
cancels. These parts do not cancel: the pixels that the two subsets do not share, the noise of the gradients, and
changes of the pattern.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.derivatives import inverse_of_lower, lower_root
from stereorig.core.field.points.result import Field
from stereorig.core.field.sequence.compose import Totals, common_share, image_slopes, in_step, rotations_of
from stereorig.core.matching.geometry import tangent_frames

_SMOOTHED = 5  # points across, over which the noise of a field is averaged
_SURELY = 1.1  # times the noise between the cameras: any more is not noise


@dataclass(frozen=True, eq=False)
class Propagated:
    """Covariances (n, 2, 2) of n points' positions in an image, propagated to a segment that begins there.

    Attributes
    ----------
    noise
        Covariance from errors that are independent from segment to segment.
    pattern
        Covariance from errors by a changed pattern, which are fully correlated from segment to segment.
    """

    noise: Float
    pattern: Float

    @staticmethod
    def nothing(n: int) -> Propagated:
        """Return the propagated covariance of the first reference, zero."""
        return Propagated(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)))

    def at(self, index: NDArray[np.intp]) -> Propagated:
        """Return the covariances of some points."""
        return Propagated(self.noise[index], self.pattern[index])

    def through(self, J: Float) -> Propagated:
        """Return the covariances in other coordinates, whose derivatives are J (n, 2, 2)."""
        turned = np.swapaxes(J, 1, 2)
        return Propagated(J @ self.noise @ turned, J @ self.pattern @ turned)


def propagate(
    pair: StereoPair,
    position_px: Float,
    offset: Float,
    G: Float,
    own: Float,
    before: Propagated,
    pattern: Float,
    subset_px: int,
    slope_share: float,
) -> Propagated:
    """Return the covariance of the current positions that is propagated to a segment beginning there, px^2.

    Parameters
    ----------
    pair
        The calibrated cameras.
    position_px, offset
        (n, 2) the points' positions in camera 1's image at the match's reference, px, and the offset from the pixel in
        the middle of the subset to there, normalised.
    G
        (n, 3, 3) of the match, about the points' own rays.
    own, before
        (n, 2, 2) covariance of the current positions by the match, and the one propagated to it, in current
        coordinates; normalised.
    pattern
        (n,) share of the variance that is a change of the surface's pattern. It adds up; the rest is camera noise,
        which cancels in the next segment.
    subset_px
        Width of the subset.
    slope_share
        Share of noise in the squares of the reference's gradients: each segment has its own.
    """
    seen, slopes = G[:, :2, 0] / G[:, 2:, 0], image_slopes(G)
    to_px = pair.cam1.lens.image_jacobian(seen)
    from_px = np.linalg.inv(pair.cam1.lens.image_jacobian(pair.cam1.rays_cam(position_px).xyz_mm[:, :2]))
    current_px = pair.cam1.lens.image_from_normalised(seen).xy
    middle_px = current_px - np.einsum("nij,nj->ni", to_px @ slopes, offset)
    common, samples = common_share(to_px @ slopes @ from_px, np.rint(current_px) - middle_px, subset_px)
    left = np.maximum(0.5 * (1.0 + samples) - common + slope_share, 0.0) * (1.0 - pattern)
    return Propagated(
        before.noise + left[:, None, None] * own, in_step(before.pattern, pattern[:, None, None] * own)
    ).through(to_px)


def pattern_share(zncc: Float) -> Float:
    """Return the share (...) of the noise variance that is a change of the surface's pattern, not the cameras' noise.

    Parameters
    ----------
    zncc
        (n, 3), or (r, c, 3), then averaged over neighbours.

    Notes
    -----
    The two cameras' images of one instant differ by noise and view; any larger difference of two images of one camera
    is not noise.
    """
    lost = 1.0 - np.asarray(zncc[..., :2], dtype=np.float32).astype(np.float64)
    if lost.ndim == 3:
        known = np.isfinite(lost.sum(axis=2, keepdims=True))
        cells = (_SMOOTHED, _SMOOTHED)
        lost[:] = cv2.blur(np.where(known, lost, 0.0), cells, borderType=cv2.BORDER_CONSTANT)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 1.0 - _SURELY * lost[..., 0] / lost[..., 1]
    return np.where(np.isfinite(share), np.maximum(share, 0.0), 0.0)


def current_covariance(field: Field) -> Float:
    """Return the own covariance (r, c, 3, 3) of the current positions, mm^2, in the precision that a file keeps."""
    C = field.covariance
    both = C[..., :3, 3:]
    total = C[..., :3, :3] + (both + np.swapaxes(both, -1, -2)) + C[..., 3:, 3:]
    return np.asarray(total.astype(np.float32).astype(np.float64))


def first_propagated(field: Field, pair: StereoPair, totals: Totals, subset_px: int, slope_share: float) -> Propagated:
    """Return the covariance, px^2, propagated to a segment that begins at a field of the first reference."""
    n = len(totals.w)
    R = pair.cam1.cam_from_sys.rotation
    mm = R @ current_covariance(field).reshape(n, 3, 3) @ R.T
    P, seen = totals.current_cam1_mm, totals.seen
    J = np.zeros((n, 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, :, 2] = -seen
    J /= P[:, 2, None, None]
    own = J @ mm @ np.swapaxes(J, 1, 2)
    xy = np.stack([field.x_px, field.y_px], axis=-1).reshape(n, 2)
    return propagate(
        pair,
        xy,
        np.zeros((n, 2)),
        totals.G,
        own,
        Propagated.nothing(n),
        pattern_share(field.zncc).ravel(),
        subset_px,
        slope_share,
    )


def added_share(field: Field, pair: StereoPair, added_px2: Float) -> Float:
    """Return the relative noise that references between the first one and a step added to its displacement.

    Parameters
    ----------
    field
        As it was measured.
    pair
        The cameras.
    added_px2
        (r, c, 2, 2) of the current positions in camera 1's image, along the surface.

    Returns
    -------
    Float
        (r, c, 3, 3) B with L B L' the part and L L' the covariance of U, V, W, L a lower triangle: smoothing, which
        scales the noise, leaves it. NaN without a point.
    """
    assert field.uvw_mm is not None
    assert field.rotation_rad is not None
    ok = field.valid
    surface = rotations_of(field.rotation_rad[ok]) @ tangent_frames(field.normal_sys[ok])[..., :2]
    along = surface @ np.linalg.inv(pair.cam1.point_jacobian(field.xyz_mm[ok] + field.uvw_mm[ok]) @ surface)
    part = along @ added_px2[ok] @ np.swapaxes(along, 1, 2)
    inverse = inverse_of_lower(lower_root(field.covariance[ok][:, 3:, 3:]))
    out = np.full((*field.shape, 3, 3), np.nan)
    out[ok] = inverse @ part @ np.swapaxes(inverse, 1, 2)
    return out
