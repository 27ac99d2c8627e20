"""Derivatives of measured positions and displacements over the cameras' parameters, at the same images.

A measured point is what the estimator makes of the matches: it stays on camera 1's ray of its pixel, its image in
camera 2 may lie off that of the ray by an offset across the epipolar line, and the same offset is taken out of camera
2's current image. All three comparisons determine it, weighted as the matching weighs them: two of them share the
reference's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.cameras.stereo import StereoPair
from core.names import CAMERAS

#: of the comparisons camera 2 at t0, camera 1 and camera 2 at t: the inverse of noise I plus the reference's in all
_WEIGHTS = np.eye(3) - 0.25
_MATCH_WEIGHTS = np.kron(_WEIGHTS, np.eye(2))
_AT_ONCE = 1024
_NOISE = np.kron(np.eye(3) + 1.0, np.eye(2))


def measured_derivatives(
    pair: StereoPair, points_mm: Float, names: Sequence[str], displaced_mm: Float | None = None
) -> Float:
    """Return derivatives of measured points over parameters by name, all images held.

    Parameters
    ----------
    pair
        The cameras.
    points_mm
        (n, 3) points at the reference, system frame.
    names
        The parameters: ``cam1.`` or ``cam2.`` and a name of the camera's parameters.
    displaced_mm
        (n, 3) their current positions.

    Returns
    -------
    Float
        (n, 3, len(names)) of X, Y, Z; with ``displaced_mm`` (n, 6, len(names)) of X, Y, Z, U, V, W. mm a unit.
    """
    return Estimator.at(pair, points_mm, displaced_mm).through(names, np.eye(len(names)))


@dataclass(frozen=True, eq=False)
class Estimator:
    """The measurement's estimator about n points: what it makes of small shifts of the images.

    Attributes
    ----------
    pair
        The cameras.
    points_mm, displaced_mm
        (n, 3) points at the reference and now, system frame; None of a shape.
    by_image
        (n, 3, 4) of X, Y, Z, or (n, 6, 8) of X, Y, Z, U, V, W over the images that the cameras' parameters predict:
        x, y of camera 1 and 2 at the reference, then now. mm/px.
    by_match
        (n, 3, 6) of U, V, W over the shifts that the three comparisons find, mm/px; None of a shape.
    """

    pair: StereoPair
    points_mm: Float
    displaced_mm: Float | None
    by_image: Float
    by_match: Float | None

    @staticmethod
    def at(pair: StereoPair, points_mm: Float, displaced_mm: Float | None = None) -> Estimator:
        """Return the estimator at points."""
        n = len(points_mm)
        A1, A2 = pair.cam1.point_jacobian(points_mm), pair.cam2.point_jacobian(points_mm)
        ray = points_mm - pair.cam1.centre_sys_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = (A2 @ ray[..., None])[..., 0]
        length = np.linalg.norm(along, axis=1)
        along /= length[:, None]
        # camera 1's equations hold exactly: its images put the point beside the ray, and camera 2's then along it
        beside = -_pseudoinverse(A1)
        seen = np.concatenate([A2 @ beside, np.broadcast_to(np.eye(2), (n, 2, 2))], axis=2)  # (n, 2, 4) of camera 2
        depth = -(along[:, None, :] @ seen) / length[:, None, None]
        first = ray[..., None] * depth
        first[..., :2] += beside
        if displaced_mm is None:
            return Estimator(pair, points_mm, None, first, None)
        # unknowns depth along camera 1's ray, offset, current X Y Z; comparisons camera 2 at t0, camera 1 and 2 at t
        across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        A = np.zeros((n, 6, 5))
        A[:, :2, 0], A[:, :2, 1] = along * length[:, None], across
        A[:, 2:4, 2:], A[:, 4:, 2:] = pair.cam1.point_jacobian(displaced_mm), pair.cam2.point_jacobian(displaced_mm)
        A[:, 4:, 1] = _carried(pair, points_mm, displaced_mm, across)
        At = np.swapaxes(A, 1, 2) @ _MATCH_WEIGHTS
        gain = np.linalg.solve(At @ A, At)
        by_match = np.asarray(gain[:, 2:] - ray[..., None] * gain[:, :1], dtype=np.float64)
        whole = np.zeros((n, 6, 8))
        whole[:, :3, :4] = first
        whole[:, 3:, :4] = -by_match[:, :, :2] @ seen
        whole[:, 3:, :2] -= beside
        whole[:, 3:, 4:] = -by_match[:, :, 2:]
        return Estimator(pair, points_mm, displaced_mm, whole, by_match)

    def through(self, names: Sequence[str], directions: Float) -> Float:
        """Return derivatives (n, 3 or 6, k) along directions (len(names), k) of the parameters by name."""
        states = [self.points_mm] if self.displaced_mm is None else [self.points_mm, self.displaced_mm]
        n, k = len(self.points_mm), directions.shape[1]
        out = np.empty((n, self.by_image.shape[1], k))
        images = np.empty((min(n, _AT_ONCE), 4 * len(states), k))
        for first in range(0, n, _AT_ONCE):  # what stays in the processor's cache
            part = slice(first, first + _AT_ONCE)
            here = images[: min(n - first, _AT_ONCE)]
            for i, points in enumerate(states):
                image_shifts(self.pair, points[part], names, directions, out=here[:, 4 * i : 4 * i + 4])
            np.matmul(self.by_image[part], here, out=out[part])
        return out

    def new_noise_share(self) -> Float:
        """Return the share of the noise of U, V, W that is new at t, as a factor T (n, 3, 3).

        Of a covariance C with the lower triangle L, L L' = C, the part L T T' L' is new. All else is the reference
        pair's noise, in all steps alike: the reference subset's is in all three comparisons, that of camera 2's match
        at t0 in the first.
        """
        assert self.by_match is not None
        every = self.by_match @ _NOISE @ np.swapaxes(self.by_match, 1, 2)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(every), self.by_match[:, :, 2:]))


def image_shifts(pair: StereoPair, points_mm: Float, names: Sequence[str], directions: Float, *, out: Float) -> None:
    """Put shifts (n, 4, k) of the images x1 y1 x2 y2 by directions (len(names), k) of the parameters into ``out``."""
    for c, (prefix, camera) in enumerate(zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)):
        known = camera.parameter_names
        own = np.zeros((len(known), directions.shape[1]))
        for k, name in enumerate(names):
            if name.startswith(f"{prefix}."):
                own[known.index(name.removeprefix(f"{prefix}."))] += directions[k]
        jacobian = camera.parameter_jacobian(points_mm)
        out[:, 2 * c : 2 * c + 2] = (jacobian.reshape(-1, len(known)) @ own).reshape(-1, 2, own.shape[1])


def _pseudoinverse(A: Float) -> Float:
    """(n, 3, 2) of matrices (n, 2, 3) of full rank."""
    At = np.swapaxes(A, 1, 2)
    G = A @ At
    a, b, c = G[:, 0, 0], G[:, 0, 1], G[:, 1, 1]
    inverse = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
    return np.asarray(At @ inverse)


def _carried(pair: StereoPair, points_mm: Float, displaced_mm: Float, across: Float) -> Float:
    """(n, 2) the same shift of the normalised image, in px at the current position."""

    def lens_jacobian(points: Float) -> Float:
        p = pair.cam2.cam_from_sys.apply(points)
        return pair.cam2.lens.image_jacobian(p[:, :2] / p[:, 2:])

    normalised = np.linalg.solve(lens_jacobian(points_mm), across[..., None])
    return np.asarray((lens_jacobian(displaced_mm) @ normalised)[..., 0])
