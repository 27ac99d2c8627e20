"""Plates whose motion is a formula with strain in one place, as exact rays see them: no image is warped.

A material point (a, b) of the plate, mm, moves to ``(a, b, 0) + shift + motion(a, b)``. Where a pixel's ray meets the
moved plane, the material point is found by Newton's steps on that formula.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera

Motion = Callable[[Float, Float], tuple[Float, Float]]
_STEPS, _SHORT_MM = 40, 1e-6


def necking(amplitude_mm: float, width_mm: float = 0.9, contraction: float = 0.0) -> Motion:
    """A neck across x: u = A tanh(x / width), its peak strain A / width, and what it contracts across that."""

    def motion(a: Float, b: Float) -> tuple[Float, Float]:
        strain = amplitude_mm / width_mm / np.cosh(np.clip(a / width_mm, -300, 300)) ** 2
        return amplitude_mm * np.tanh(a / width_mm), -contraction * strain * b

    return motion


def kink(strain: float, angle_deg: float = 12.0) -> Motion:
    """A line over which the strain across it jumps from nothing to ``strain``."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))

    def motion(a: Float, b: Float) -> tuple[Float, Float]:
        across = strain * np.maximum(c * a + s * b, 0.0)
        return c * across, s * across

    return motion


def band(strain: float, width_mm: float = 0.8, angle_deg: float = 35.0) -> Motion:
    """A plastic band that lies askew, strained and sheared evenly between two sharp borders."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))

    def motion(a: Float, b: Float) -> tuple[Float, Float]:
        across = strain * np.clip(c * a + s * b, -0.5 * width_mm, 0.5 * width_mm)
        return (c - 0.4 * s) * across, (s + 0.4 * c) * across

    return motion


def notch(stress_strain: float, radius_mm: float = 0.8, poisson: float = 0.33) -> Motion:
    """Kirsch's displacement about a round hole in a plate under tension along x, plane stress, far strain given."""
    kappa = (3.0 - poisson) / (1.0 + poisson)
    moved = stress_strain * (1.0 + poisson) * radius_mm  # stress over twice the shear modulus, times the radius

    def motion(a: Float, b: Float) -> tuple[Float, Float]:
        reach = np.hypot(a, b) / radius_mm
        r, inside = np.maximum(reach, 1.0), np.minimum(reach, 1.0)  # a plug fills the hole, strained along its radii
        t = np.arctan2(b, a)
        radial = (
            0.25
            * moved
            * (
                r * (kappa - 1.0 + 2.0 * np.cos(2 * t))
                + 2.0 / r * (1.0 + (1.0 + kappa) * np.cos(2 * t))
                - 2.0 / r**3 * np.cos(2 * t)
            )
        )
        round_ = 0.25 * moved * (-2.0 * r + 2.0 / r * (1.0 - kappa) - 2.0 / r**3) * np.sin(2 * t)
        radial, round_ = radial * inside, round_ * inside
        return radial * np.cos(t) - round_ * np.sin(t), radial * np.sin(t) + round_ * np.cos(t)

    return motion


@dataclass(frozen=True)
class Strained:
    """The plate in one state; ``motion`` None: as it was at first."""

    motion: Motion | None = None
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def position(self, ab: Float) -> Float:
        """System coordinates (..., 3) of material points (..., 2)."""
        moved = np.zeros((*ab.shape[:-1], 3))
        moved[..., :2] = ab
        if self.motion is not None:
            u, v = self.motion(ab[..., 0], ab[..., 1])
            moved[..., 0] += u
            moved[..., 1] += v
        return moved + np.asarray(self.shift_mm)

    def material(self, camera: Camera, xy: Float) -> Float:
        """Material coordinates (..., 2) that pixel positions see."""
        normal = np.array([0.0, 0.0, 1.0])
        seen = camera.back_project_to_plane(xy, point_sys_mm=np.asarray(self.shift_mm), normal_sys=normal).xyz_mm
        target = (seen - np.asarray(self.shift_mm))[..., :2].reshape(-1, 2)
        ab = target.copy()
        if self.motion is None:
            return ab.reshape(*seen.shape[:-1], 2)
        left = np.arange(len(ab))
        for _ in range(_STEPS):
            a, b = ab[left].T
            here, ax, bx = (
                np.stack(self.motion(a + da, b + db), -1) for da, db in ((0.0, 0.0), (_SHORT_MM, 0.0), (0.0, _SHORT_MM))
            )
            off = target[left] - ab[left] - here
            J = np.stack([(ax - here) / _SHORT_MM, (bx - here) / _SHORT_MM], -1) + np.eye(2)
            step = np.linalg.solve(J, off[..., None])[..., 0]
            size = np.linalg.norm(step, axis=1, keepdims=True)
            ab[left] += step * np.minimum(1.0, 0.3 / np.maximum(size, 1e-12))
            left = left[np.abs(off).max(axis=1) > 1e-8]
            if len(left) == 0:
                return ab.reshape(*seen.shape[:-1], 2)
        raise ValueError(f"{len(left)} rays find no material point")
