"""Derivatives of measured positions and displacements over the cameras' parameters, at the same images.

The estimator computes a point from the matches so that it stays on camera 1's ray of its pixel; its image in camera 2
may be off the ray's image by an offset across the epipolar line, and the same offset is subtracted from camera 2's
current image. All three comparisons determine it, weighted as the matching weighs them: two of them share the
reference's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

#: of the comparisons camera 2 at t0, camera 1 and camera 2 at t: the inverse of noise I plus the reference's in all
WEIGHTS = np.eye(3) - 0.25
_AT_ONCE = 1024
_FIRM = 1e-12  # share of the variance
Index = slice | Bool | NDArray[np.int64]


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
class ReferenceView:
    """The geometry of n points at the reference in both cameras: the same in all steps of a test.

    Attributes
    ----------
    pair
        The cameras.
    points_mm
        (n, 3) points at the reference, system frame.
    ray
        (n, 3) unit vectors from camera 1 to them.
    by_point1, by_point2
        (n, 2, 3) of the images over the points, px/mm.
    along, across
        (n, 2) unit vectors along and across the epipolar line in camera 2.
    px_per_mm
        (n,) shift of camera 2's image for 1 mm along the ray, px/mm.
    """

    pair: StereoPair
    points_mm: Float
    ray: Float
    by_point1: Float
    by_point2: Float
    along: Float
    across: Float
    px_per_mm: Float

    @staticmethod
    def of(pair: StereoPair, points_mm: Float) -> ReferenceView:
        """Return the view of points."""
        A1, A2 = pair.cam1.point_jacobian(points_mm), pair.cam2.point_jacobian(points_mm)
        ray = points_mm - pair.cam1.centre_sys_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = (A2 @ ray[..., None])[..., 0]
        length = np.linalg.norm(along, axis=1)
        along /= length[:, None]
        return ReferenceView(
            pair, points_mm, ray, A1, A2, along, np.stack([-along[:, 1], along[:, 0]], axis=-1), length
        )

    def keep(self) -> None:
        """Compute the derivatives that all steps need, once; views from :meth:`at` contain their part of them."""
        _ = self.by_image, self.by_parameters, self.across_normalised

    def at(self, some: Index) -> ReferenceView:
        """Return the view of some of the points, with the derivatives that are already computed."""
        names = ("ray", "by_point1", "by_point2", "along", "across", "px_per_mm")
        part = ReferenceView(self.pair, self.points_mm[some], *(getattr(self, name)[some] for name in names))
        for name in ("off_ray", "seen", "by_image", "across_normalised"):
            if name in self.__dict__:
                part.__dict__[name] = self.__dict__[name][some]
        if "by_parameters" in self.__dict__:
            part.__dict__["by_parameters"] = tuple(values[some] for values in self.by_parameters)
        return part

    @cached_property
    def off_ray(self) -> Float:
        """(n, 3, 2) derivative of the points over camera 1's predicted images, which shifts them off the ray."""
        return -pseudoinverse(self.by_point1)

    @cached_property
    def seen(self) -> Float:
        """(n, 2, 4) derivative of camera 2's image over both cameras' predicted images, points shifted off the ray."""
        eye = np.broadcast_to(np.eye(2), (len(self.ray), 2, 2))
        return np.concatenate([self.by_point2 @ self.off_ray, eye], axis=2)

    @cached_property
    def by_image(self) -> Float:
        """(n, 3, 4) of X, Y, Z over the images that the cameras' parameters predict, mm/px.

        Camera 1's equations hold exactly; camera 2's then put the point along the ray.
        """
        depth = -(self.along[:, None, :] @ self.seen) / self.px_per_mm[:, None, None]
        out = self.ray[..., None] * depth
        out[..., :2] += self.off_ray
        return np.asarray(out)

    @cached_property
    def by_parameters(self) -> tuple[Float, Float]:
        """(n, 2, p) of either camera's images over its parameters."""
        return self.pair.cam1.parameter_jacobian(self.points_mm), self.pair.cam2.parameter_jacobian(self.points_mm)

    @cached_property
    def across_normalised(self) -> Float:
        """(n, 2) the unit offset across the epipolar line as a shift of camera 2's normalised image."""
        p = self.pair.cam2.cam_from_sys.apply(self.points_mm)
        by_normalised = self.pair.cam2.lens.image_jacobian(p[:, :2] / p[:, 2:])
        return np.asarray(np.linalg.solve(by_normalised, self.across[..., None])[..., 0])

    def carried(self, displaced_mm: Float) -> Float:
        """Return (n, 2) the unit offset across the epipolar line as the same shift of camera 2's normalised image.

        In px at the current positions (n, 3).
        """
        p = self.pair.cam2.cam_from_sys.apply(displaced_mm)
        by_normalised = self.pair.cam2.lens.image_jacobian(p[:, :2] / p[:, 2:])
        return np.asarray((by_normalised @ self.across_normalised[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Estimator:
    """The measurement's estimator linearised about n points: its derivatives over small shifts of the images.

    Attributes
    ----------
    reference
        How the cameras see the points at the reference.
    displaced_mm
        (n, 3) their current positions, system frame; None of a shape.
    by_image
        (n, 3, 4) of X, Y, Z, or (n, 6, 8) of X, Y, Z, U, V, W over the images that the cameras' parameters predict:
        x, y of camera 1 and 2 at the reference, then now. mm/px.
    by_match
        (n, 3, 6) of U, V, W over the shifts that the three comparisons find, mm/px; None of a shape.
    by_parameters
        (n, 2, p) of either camera's current images over its parameters; empty of a shape.
    """

    reference: ReferenceView
    displaced_mm: Float | None
    by_image: Float
    by_match: Float | None
    by_parameters: tuple[Float, ...]

    @staticmethod
    def at(
        pair: StereoPair, points_mm: Float, displaced_mm: Float | None = None, reference: ReferenceView | None = None
    ) -> Estimator:
        """Return the estimator at points; ``reference`` is theirs, if it is known."""
        from stereorig.core.common.estimates import estimates  # slow to load, and not every start needs it

        seen = ReferenceView.of(pair, points_mm) if reference is None else reference
        if displaced_mm is None:
            return Estimator(seen, None, seen.by_image, None, ())
        now = pair.cam1.parameter_jacobian(displaced_mm), pair.cam2.parameter_jacobian(displaced_mm)
        ray = displaced_mm - pair.cam1.centre_sys_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        by_match, by_image = estimates(
            (seen.ray, seen.along, seen.across, seen.px_per_mm),
            (seen.off_ray, seen.seen, seen.by_image, seen.across_normalised),
            now,
            (pair.cam1.cam_from_sys.rotation, pair.cam2.cam_from_sys.rotation),
            ray,
            pair.cam2.cam_from_sys.apply(displaced_mm)[:, 2],
        )
        return Estimator(seen, displaced_mm, by_image, by_match, now)

    def through(self, names: Sequence[str], directions: Float, some: slice = slice(None)) -> Float:
        """Return derivatives (n, 3 or 6, k) along directions (len(names), k) of the parameters by name.

        ``some`` takes a part of the points.
        """
        by_image = self.by_image[some]
        now = [by_parameters[some] for by_parameters in self.by_parameters]
        n, m, _ = by_image.shape
        cameras = (self.reference.pair.cam1, self.reference.pair.cam2)
        own = np.concatenate(
            [_own_part(camera, prefix, names, directions) for prefix, camera in zip(CAMERAS, cameras, strict=True)]
        )
        before = [by_parameters[some] for by_parameters in self.reference.by_parameters]
        out = np.empty((n, m, directions.shape[1]))
        for first in range(0, n, _AT_ONCE):  # points whose arrays stay in the processor's cache
            part = slice(first, first + _AT_ONCE)
            rows, parts = by_image[part], []
            for c in range(2):
                by_own = rows[:, :, 2 * c : 2 * c + 2] @ before[c][part]
                if now:
                    by_own += rows[:, :, 4 + 2 * c : 6 + 2 * c] @ now[c][part]
                parts.append(by_own)
            np.matmul(np.concatenate(parts, axis=2), own, out=out[part])
        return out

    def new_noise(self, own: Float) -> Float:
        """Return the part (n, 3, 3) of the noise of U, V, W that is new at t, of its covariance (n, 3, 3).

        ``own`` is its lower triangle L, L L' the covariance. The rest is the reference pair's noise, which is alike in
        all steps: the reference subset's noise is in all three comparisons, the noise of camera 2's match at t0 in the
        first.
        """
        assert self.by_match is not None
        from stereorig.core.common.estimates import new_noise  # slow to load, and not every start needs it

        return new_noise(self.by_match, own)


def lower_root(covariance: Float) -> Float:
    """Return lower triangles (n, 3, 3) L with L L' the covariances (n, 3, 3).

    Smoothed noise may have no variance in a direction, so that a rounding's worth of the whole is added.
    """
    size = np.trace(covariance, axis1=1, axis2=2)[:, None, None]
    firm = covariance + np.maximum(_FIRM * size, np.finfo(np.float64).tiny) * np.eye(3)
    try:
        return np.asarray(np.linalg.cholesky(firm))
    except np.linalg.LinAlgError:  # rounding left one of them a negative variance
        value, vector = np.linalg.eigh(firm)
        upper = np.linalg.qr(np.sqrt(np.maximum(value, 0.0))[:, :, None] * np.swapaxes(vector, 1, 2), mode="r")
        sign = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0.0, -1.0, 1.0)
        return np.asarray(np.swapaxes(upper, 1, 2) * sign[:, None, :])


def inverse_of_lower(L: Float) -> Float:
    """Return the inverses (n, 3, 3) of lower triangles (n, 3, 3)."""
    out = np.zeros_like(L)
    for k in range(3):
        out[:, k, k] = 1.0 / L[:, k, k]
    out[:, 1, 0] = -L[:, 1, 0] * out[:, 0, 0] * out[:, 1, 1]
    out[:, 2, 1] = -L[:, 2, 1] * out[:, 1, 1] * out[:, 2, 2]
    out[:, 2, 0] = -(L[:, 2, 0] * out[:, 0, 0] + L[:, 2, 1] * out[:, 1, 0]) * out[:, 2, 2]
    return out


def _own_part(camera: Camera, prefix: str, names: Sequence[str], directions: Float) -> Float:
    """(p, k) of directions (len(names), k) in one camera's parameters, in their order."""
    known = camera.parameter_names
    own = np.zeros((len(known), directions.shape[1]))
    for k, name in enumerate(names):
        if name.startswith(f"{prefix}."):
            own[known.index(name.removeprefix(f"{prefix}."))] += directions[k]
    return own


def pseudoinverse(A: Float) -> Float:
    """Return the pseudoinverses (n, 3, 2) of matrices (n, 2, 3) of full rank."""
    At = np.swapaxes(A, 1, 2)
    G = A @ At
    a, b, c = G[:, 0, 0], G[:, 0, 1], G[:, 1, 1]
    inverse = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
    return np.asarray(At @ inverse)
