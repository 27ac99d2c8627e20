"""The calibrated pair: relative pose, epipolar lines, triangulation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.camera import Camera, RigidTransform, SpacePoints, project_cam
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS

Rays = tuple[SpacePoints, SpacePoints]
"""Rays (n, 3) of matched points in both cameras' own frames."""
_ROUNDING = 1e-12  # share of the cameras' distances from the origin: composed poses leave so much of a zero


def some_rays(rays: Rays, which: NDArray[np.int64] | Bool) -> Rays:
    """Return the rays of some of the points, by their indices or (n,) True."""
    one, two = (SpacePoints(ray.xyz_mm[which], ray.valid[which]) for ray in rays)
    return one, two


@dataclass(frozen=True)
class StereoPair:
    """Camera 1 (reference) and camera 2 in one system frame."""

    cam1: Camera
    cam2: Camera

    @cached_property
    def cam2_from_cam1(self) -> RigidTransform:
        """The relative pose used by the matching."""
        return self.cam2.cam_from_sys @ self.cam1.sys_from_cam

    def values(self) -> dict[str, float]:
        """Return both cameras' parameters by name: ``cam1.`` or ``cam2.`` and the camera's own name."""
        return {
            f"{name}.{key}": value
            for name, camera in zip(CAMERAS, (self.cam1, self.cam2), strict=True)
            for key, value in camera.values().items()
        }

    @property
    def baseline_mm(self) -> float:
        """Distance of the two pinholes."""
        return float(np.linalg.norm(self.cam2_from_cam1.translation_mm))

    def require_baseline(self) -> None:
        """Refuse cameras whose pinholes coincide: every depth then looks the same to both.

        Raises
        ------
        InputError
            ``baseline_zero``.
        """
        reach_mm = sum(float(np.linalg.norm(c.cam_from_sys.translation_mm)) for c in (self.cam1, self.cam2))
        if not self.baseline_mm > _ROUNDING * reach_mm:
            raise InputError(
                f"the baseline is {self.baseline_mm:.3g} mm: both cameras have the same position, and no depth follows "
                "from their images.",
                code="baseline_zero",
                remedy="Check the translation between the cameras in the calibration.",
            )

    @property
    def stereo_angle_rad(self) -> float:
        """Angle between the two optical axes."""
        return float(np.arccos(np.clip(self.cam2_from_cam1.rotation[2, 2], -1.0, 1.0)))

    def epipolar_residual_px(self, xy1_px: ArrayLike, xy2_px: ArrayLike) -> Float:
        """Signed distance (...) in camera 2 pixels from ``xy2_px`` to the epipolar line of ``xy1_px``.

        To first order, through camera 2's lens Jacobian; NaN where a pixel has no ray.
        """
        return self.epipolar_residual_of_rays(*self.rays(xy1_px, xy2_px))

    def rays(self, xy1_px: ArrayLike, xy2_px: ArrayLike) -> Rays:
        """Return the rays of pixels in both cameras' own frames: a pose has no part in them."""
        return self.cam1.rays_cam(xy1_px), self.cam2.rays_cam(xy2_px)

    def epipolar_residual_of_rays(self, ray1: SpacePoints, ray2: SpacePoints) -> Float:
        """Return the same of rays in the cameras' own frames: a lens is inverted once for several poses."""
        jacobian = self.cam2.lens.image_jacobian(ray2.xyz_mm[..., :2])
        return self.epipolar_residual_at(ray1, ray2, jacobian)

    def epipolar_residual_at(self, ray1: SpacePoints, ray2: SpacePoints, jacobian: Float) -> Float:
        """Return the same with camera 2's lens Jacobian (..., 2, 2) at its rays: a pose has no part in it."""
        a, b = (ray1.xyz_mm @ self._essential[:, k] for k in (0, 1))  # plane through both pinholes and ray 1
        c = ray1.xyz_mm @ self._essential[:, 2]
        x, y, z = np.moveaxis(ray2.xyz_mm, -1, 0)
        algebraic = a * x + b * y + c * z
        # d(algebraic)/d(px) = (a, b) J^-1, a matrix of 2 x 2
        (p, q), (r, s) = np.moveaxis(jacobian, (-2, -1), (0, 1))
        return np.asarray(algebraic * np.abs(p * s - q * r) / np.hypot(a * s - b * r, b * p - a * q))

    @cached_property
    def _essential(self) -> Float:
        """(3, 3) that takes a ray of camera 1, a row, to the normal of its epipolar plane in camera 2."""
        R, t = self.cam2_from_cam1.rotation, self.cam2_from_cam1.translation_mm
        return np.cross(t, R.T)

    def triangulate(self, xy1_px: ArrayLike, xy2_px: ArrayLike) -> SpacePoints:
        """Mid-point of the shortest segment between the two rays, in the system frame."""
        return self.triangulate_rays(*self.rays(xy1_px, xy2_px))

    def triangulate_rays(self, ray1: SpacePoints, ray2: SpacePoints) -> SpacePoints:
        """Return the same of rays in the cameras' own frames: a lens is inverted once for several poses."""
        d1 = ray1.xyz_mm @ self.cam1.cam_from_sys.rotation
        d2 = ray2.xyz_mm @ self.cam2.cam_from_sys.rotation
        c1, c2 = self.cam1.centre_sys_mm, self.cam2.centre_sys_mm
        a, b, c = (d1 * d1).sum(-1), (d1 * d2).sum(-1), (d2 * d2).sum(-1)
        base = c2 - c1
        e, f = d1 @ base, d2 @ base
        with np.errstate(divide="ignore", invalid="ignore"):
            det = a * c - b * b
            s1 = (c * e - b * f) / det
            s2 = (b * e - a * f) / det
        valid = ray1.valid & ray2.valid & (det > 0.0) & (s1 > 0.0) & (s2 > 0.0)
        mid = 0.5 * (c1 + d1 * s1[..., None] + c2 + d2 * s2[..., None])
        return SpacePoints(np.where(valid[..., None], mid, np.nan), valid)

    def image2_at_depth(self, xy1_px: ArrayLike, z_cam1_mm: ArrayLike) -> Float:
        """Project the point on camera 1's ray at depth ``z_cam1_mm`` into camera 2; NaN outside its domain."""
        p = self.cam1.rays_cam(xy1_px).xyz_mm * np.asarray(z_cam1_mm, dtype=np.float64)[..., None]
        return project_cam(self.cam2.lens, self.cam2_from_cam1.apply(p)).xy
