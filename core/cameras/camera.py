"""A camera of the paper: lens, sensor and pose, Eqs. (1) to (8), in both directions.

Frames: ``sys`` is the system frame that the calibration target defines; ``cam`` has its origin in the pinhole, Z along
the optical axis away from the camera, X along the rows, Y down. ``cam_from_sys`` maps sys points into the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.lens import LensModel, MappedPoints, SeidelLens

POSE_NAMES = ("alpha_rad", "beta_rad", "gamma_rad", "x0_mm", "y0_mm", "z0_mm")
TEN_PARAMETER_NAMES = ("phd_px", "cx_px", "cy_px", "kappa_per_px2", *POSE_NAMES)
ELEVEN_PARAMETER_NAMES = (*SeidelLens.parameter_names, *POSE_NAMES)


class SpacePoints(NamedTuple):
    """Points in space with their domain: ``xyz_mm`` (..., 3), NaN where ``valid`` (...) is False."""

    xyz_mm: Float
    valid: Bool


@dataclass(frozen=True)
class RigidTransform:
    """``x_b = rotation x_a + translation_mm``; a variable of this type is named ``b_from_a``.

    Attributes
    ----------
    rotation
        (3, 3) proper rotation.
    translation_mm
        (3,).
    """

    rotation: Float
    translation_mm: Float

    def __post_init__(self) -> None:
        R = np.array(self.rotation, dtype=np.float64)
        t = np.array(self.translation_mm, dtype=np.float64)
        if R.shape != (3, 3) or t.shape != (3,):
            raise ValueError(f"rotation must be (3, 3) and translation (3,), got {R.shape} and {t.shape}")
        R.setflags(write=False)
        t.setflags(write=False)
        object.__setattr__(self, "rotation", R)
        object.__setattr__(self, "translation_mm", t)

    def apply(self, points_mm: ArrayLike) -> Float:
        """Transform points (..., 3)."""
        return np.asarray(points_mm, dtype=np.float64) @ self.rotation.T + self.translation_mm

    def inverse(self) -> RigidTransform:
        """Return ``a_from_b``."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Compose: ``c_from_a = c_from_b @ b_from_a``."""
        return RigidTransform(
            self.rotation @ other.rotation, self.rotation @ other.translation_mm + self.translation_mm
        )

    @staticmethod
    def identity() -> RigidTransform:
        """Return the identity transform."""
        return RigidTransform(np.eye(3), np.zeros(3))


def _axis_rotations(alpha: float, beta: float, gamma: float) -> tuple[tuple[Float, Float], ...]:
    ca, sa, cb, sb, cg, sg = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta), np.cos(gamma), np.sin(gamma)
    rz = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
    drz = np.array([[-sa, -ca, 0.0], [ca, -sa, 0.0], [0.0, 0.0, 0.0]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cb, -sb], [0.0, sb, cb]])
    drx = np.array([[0.0, 0.0, 0.0], [0.0, -sb, -cb], [0.0, cb, -sb]])
    ry = np.array([[cg, 0.0, sg], [0.0, 1.0, 0.0], [-sg, 0.0, cg]])
    dry = np.array([[-sg, 0.0, cg], [0.0, 0.0, 0.0], [-cg, 0.0, -sg]])
    return (rx, drx), (ry, dry), (rz, drz)


def rotation_from_angles(alpha_rad: float, beta_rad: float, gamma_rad: float) -> Float:
    """Return R = Rx(beta) Ry(gamma) Rz(alpha), Eq. (1), active and right-handed."""
    (rx, _), (ry, _), (rz, _) = _axis_rotations(alpha_rad, beta_rad, gamma_rad)
    return np.asarray(rx @ ry @ rz)


def rotation_derivatives(alpha_rad: float, beta_rad: float, gamma_rad: float) -> Float:
    """Return dR/d(alpha, beta, gamma), (3, 3, 3), first axis the angle."""
    (rx, drx), (ry, dry), (rz, drz) = _axis_rotations(alpha_rad, beta_rad, gamma_rad)
    return np.stack([rx @ ry @ drz, drx @ ry @ rz, rx @ dry @ rz])


def angles_from_rotation(rotation: ArrayLike) -> tuple[float, float, float]:
    """Return (alpha, beta, gamma) of Eq. (1) with gamma in [-pi/2, pi/2]."""
    R = np.asarray(rotation, dtype=np.float64)
    gamma = float(np.arctan2(R[0, 2], np.hypot(R[0, 0], R[0, 1])))
    return float(np.arctan2(-R[0, 1], R[0, 0])), float(np.arctan2(-R[1, 2], R[2, 2])), gamma


@dataclass(frozen=True)
class Camera:
    """One calibrated camera.

    Attributes
    ----------
    lens
        Intrinsic part.
    cam_from_sys
        Extrinsic part, Eq. (3), at dZ = 0.
    """

    lens: LensModel
    cam_from_sys: RigidTransform

    @cached_property
    def sys_from_cam(self) -> RigidTransform:
        """The inverse of ``cam_from_sys``."""
        return self.cam_from_sys.inverse()

    @property
    def centre_sys_mm(self) -> Float:
        """The pinhole in the system frame, (3,)."""
        return self.sys_from_cam.translation_mm

    @staticmethod
    def from_paper(
        *,
        phd_px: float,
        cx_px: float,
        cy_px: float,
        kappa_per_px2: float,
        aspect: float,
        alpha_rad: float,
        beta_rad: float,
        gamma_rad: float,
        x0_mm: float,
        y0_mm: float,
        z0_mm: float,
    ) -> Camera:
        """Build a camera from the paper's eleven parameters."""
        pose = RigidTransform(rotation_from_angles(alpha_rad, beta_rad, gamma_rad), np.array([x0_mm, y0_mm, z0_mm]))
        return Camera(SeidelLens(phd_px, cx_px, cy_px, kappa_per_px2, aspect), pose)

    def values(self) -> dict[str, float]:
        """Return the values of :attr:`parameter_names`, by name."""
        alpha, beta, gamma = angles_from_rotation(self.cam_from_sys.rotation)
        pose = (alpha, beta, gamma, *(float(v) for v in self.cam_from_sys.translation_mm))
        lens = {name: float(getattr(self.lens, name)) for name in self.lens.parameter_names}
        return lens | dict(zip(POSE_NAMES, pose, strict=True))

    def paper_parameters(self) -> dict[str, float]:
        """Return the eleven parameters of a camera with the paper's lens.

        Raises
        ------
        TypeError
            If the lens is not a :class:`SeidelLens`.
        """
        if not isinstance(self.lens, SeidelLens):
            raise TypeError(f"a {type(self.lens).__name__} has no form in the paper's eleven parameters")
        return self.values()

    def moved(self, dz_mm: float) -> Camera:
        """Return the camera after travelling ``dz_mm`` along its optical axis, away from the target (9), (10)."""
        shift = np.array([0.0, 0.0, dz_mm])
        return Camera(self.lens, RigidTransform(self.cam_from_sys.rotation, self.cam_from_sys.translation_mm + shift))

    def project(self, points_sys_mm: ArrayLike) -> MappedPoints:
        """Project points (..., 3) of the system frame to image pixels (..., 2), Eqs. (3) to (8).

        Points behind the camera or outside the lens model's domain are not valid.
        """
        return project_cam(self.lens, self.cam_from_sys.apply(points_sys_mm))

    def point_jacobian(self, points_sys_mm: ArrayLike) -> Float:
        """Return d(image px) / d(X_sys, Y_sys, Z_sys) in px/mm, (..., 2, 3)."""
        p = self.cam_from_sys.apply(points_sys_mm)
        n = p[..., :2] / p[..., 2:]
        return np.asarray(self.lens.image_jacobian(n) @ normalised_jacobian(p) @ self.cam_from_sys.rotation)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names, with units, of the numbers in :meth:`parameter_jacobian`'s last axis: the lens's, then the pose's."""
        return (*self.lens.parameter_names, *POSE_NAMES)

    def parameter_jacobian(self, points_sys_mm: ArrayLike) -> Float:
        """Return d(image px) / d(:attr:`parameter_names`), (..., 2, n), at points (..., 3) of the system frame."""
        n_lens = len(self.lens.parameter_names)
        points = np.asarray(points_sys_mm, dtype=np.float64)
        p = self.cam_from_sys.apply(points)
        n = p[..., :2] / p[..., 2:]
        to_cam = self.lens.image_jacobian(n) @ normalised_jacobian(p)
        jac = np.empty((*points.shape[:-1], 2, n_lens + len(POSE_NAMES)))
        jac[..., :n_lens] = self.lens.parameter_jacobian(n)
        for i, dR in enumerate(rotation_derivatives(*angles_from_rotation(self.cam_from_sys.rotation))):
            jac[..., n_lens + i] = np.einsum("...ij,...j->...i", to_cam, points @ dR.T)
        jac[..., n_lens + 3 :] = to_cam
        return jac

    def rays_cam(self, xy_px: ArrayLike) -> SpacePoints:
        """Back-project pixels (..., 2) to rays (X, Y, 1) in the camera frame, Eqs. (8), (7), (5)."""
        n = self.lens.normalised_from_image(xy_px)
        return SpacePoints(np.concatenate([n.xy, np.where(n.valid, 1.0, np.nan)[..., None]], axis=-1), n.valid)

    def back_project_to_plane(
        self, xy_px: ArrayLike, *, point_sys_mm: ArrayLike = (0.0, 0.0, 0.0), normal_sys: ArrayLike = (0.0, 0.0, 1.0)
    ) -> SpacePoints:
        """Meet the pixels' rays with a plane of the system frame; the target plane by default.

        Rays that run along the plane or meet it behind the camera are not valid.
        """
        rays = self.rays_cam(xy_px)
        direction = rays.xyz_mm @ self.cam_from_sys.rotation  # rows times R = R^T applied
        normal = np.asarray(normal_sys, dtype=np.float64)
        centre = self.centre_sys_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = ((np.asarray(point_sys_mm, dtype=np.float64) - centre) @ normal) / (direction @ normal)
        valid = rays.valid & np.isfinite(depth) & (depth > 0.0)
        return SpacePoints(centre + direction * np.where(valid, depth, np.nan)[..., None], valid)

    def back_project_at_depth(self, xy_px: ArrayLike, z_cam_mm: ArrayLike) -> SpacePoints:
        """Return system points (..., 3) on the pixels' rays at the depth ``z_cam_mm`` (...) in the camera frame."""
        rays = self.rays_cam(xy_px)
        depth = np.asarray(z_cam_mm, dtype=np.float64)
        valid = rays.valid & np.isfinite(depth) & (depth > 0.0)
        p = rays.xyz_mm * np.where(valid, depth, np.nan)[..., None]
        return SpacePoints(self.sys_from_cam.apply(p), valid)


def project_cam(lens: LensModel, points_cam_mm: ArrayLike) -> MappedPoints:
    """Project points (..., 3) of a camera's own frame to its image, Eqs. (5) to (8)."""
    p = np.asarray(points_cam_mm, dtype=np.float64)
    in_front = p[..., 2] > 0.0
    n = p[..., :2] / np.where(in_front, p[..., 2], np.nan)[..., None]
    return lens.image_from_normalised(n)


def normalised_jacobian(points_cam_mm: Float) -> Float:
    """Return d(X/Z, Y/Z) / d(X, Y, Z), (..., 2, 3)."""
    z = points_cam_mm[..., 2]
    jac = np.zeros((*points_cam_mm.shape[:-1], 2, 3))
    jac[..., 0, 0] = 1.0 / z
    jac[..., 1, 1] = 1.0 / z
    jac[..., 0, 2] = -points_cam_mm[..., 0] / z**2
    jac[..., 1, 2] = -points_cam_mm[..., 1] / z**2
    return jac
