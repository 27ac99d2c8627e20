"""A speckled panel that bulges towards the cameras between two pictures, by exact rays and a spline of fifth degree.

Nothing of `core` or `sim` makes the pictures; cameras are those of `tests.support.relief_rig`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.support.relief_parts import calibrated
from tests.support.relief_rig import ReliefCamera, exposed, two_cameras

Array = NDArray[np.float64]
_KNOT_MM, _KNOTS = 0.012, 2048
_BLUR_STEP_PX = 0.1
_SAMPLES = 2  # a side, of a pixel


@dataclass(frozen=True)
class Beside:
    """A field beside the truth: share of valid points; rms and worst of their errors over the reported sigma."""

    valid: float
    ratio: Array
    worst: float


@dataclass(frozen=True, eq=False)
class BulgedPanel:
    """A panel of 16 x 14 mm that bulges by ``bulge_mm`` and shifts by ``shift_mm``; a pixel is 33 um of it."""

    bulge_mm: float = 0.0
    shift_mm: tuple[float, float] = (0.02, -0.01)
    size: tuple[int, int] = (420, 340)
    speckle_mm: float = 0.16
    spacing_px: int = 14

    @cached_property
    def cameras(self) -> tuple[ReliefCamera, ReliefCamera]:
        """Two cameras, 25 degrees apart."""
        return two_cameras(self.size, f_px=3000.0, standoff_mm=100.0, angle_rad=0.436)

    @cached_property
    def pair(self) -> StereoPair:
        """Their calibration."""
        return calibrated(self.cameras)

    @cached_property
    def grid(self) -> PointGrid:
        """The points."""
        w, h = self.size
        return PointGrid.rectangle(30, 30, w - 30, h - 30, spacing_px=self.spacing_px)

    def _height(self, x: Array, y: Array, moved: bool) -> Array:
        if not moved:
            return np.zeros_like(x)
        along, down = (np.cos(np.pi * np.clip(v / span, -0.5, 0.5)) ** 2 for v, span in ((x, 16.0), (y, 14.0)))
        return np.asarray(-self.bulge_mm * along * down)

    def points(self, camera: ReliefCamera, px: Array, moved: bool) -> Array:
        """(..., 3) mm of the panel at pixels (..., 2)."""
        centre, direction = camera.rays(px)
        t = -centre[2] / direction[..., 2]
        for _ in range(12):
            p = centre + t[..., None] * direction
            t = t + (self._height(p[..., 0], p[..., 1], moved) - p[..., 2]) / direction[..., 2]
        return np.asarray(centre + t[..., None] * direction)

    @cached_property
    def _texture(self) -> Array:
        raw = gaussian_filter(
            np.random.default_rng(0).standard_normal((_KNOTS, _KNOTS)), 0.32 * self.speckle_mm / _KNOT_MM, mode="wrap"
        )
        return np.asarray(spline_filter(0.5 * np.tanh(1.6 * raw / raw.std()) + 0.5, 5, mode="grid-wrap"))

    def _picture(self, camera: ReliefCamera, moved: bool) -> Array:
        w, h = self.size
        y, x = np.mgrid[:h, :w].astype(float)
        out, taps = np.zeros((h, w)), (np.arange(_SAMPLES) - 0.5 * (_SAMPLES - 1)) / _SAMPLES
        for a in taps:
            for b in taps:
                p = self.points(camera, np.stack([x + a, y + b], -1), moved)
                material = p[..., :2] - np.array(self.shift_mm) * moved
                at = material[..., ::-1] / _KNOT_MM + _KNOTS / 2
                out += map_coordinates(
                    self._texture, np.moveaxis(at, -1, 0), order=5, prefilter=False, mode="grid-wrap"
                )
        return 50.0 + 150.0 * out / _SAMPLES**2

    @cached_property
    def clean(self) -> list[Array]:
        """Both cameras at the reference, then both at t, in focus and without noise."""
        return [self._picture(camera, moved) for moved in (False, True) for camera in self.cameras]

    def blur_by_height(self, k: int, low_px: float, high_px: float) -> Array:
        """Picture ``k`` at t, blurred by ``low_px`` on the panel's rim and by ``high_px`` on its crest."""
        w, h = self.size
        y, x = np.mgrid[:h, :w].astype(float)
        height = -self.points(self.cameras[k - 2], np.stack([x, y], -1), True)[..., 2] / self.bulge_mm
        level = (low_px + (high_px - low_px) * height) / _BLUR_STEP_PX
        stack = np.stack([gaussian_filter(self.clean[k], _BLUR_STEP_PX * i) for i in range(int(level.max()) + 2)])
        below = level.astype(int)
        rows, cols = np.indices(level.shape)
        share = level - below
        return np.asarray((1.0 - share) * stack[below, rows, cols] + share * stack[below + 1, rows, cols])

    def measured(
        self, images: list[Array], *, noise: float = 2.0, seed: int = 0, options: MeasureOptions | None = None
    ) -> Field:
        """The field of two pictures (a shape) or four, with noise."""
        rng = np.random.default_rng(seed)
        taken = [exposed(image, noise, rng) for image in images]
        options = options or MeasureOptions(subset_px=21, patch="affine")
        pair = ReferencePair(self.pair, *taken[:2])
        return pair.shape(self.grid, options) if len(taken) == 2 else pair.motion(*taken[2:], self.grid, options)

    def beside(self, field: Field) -> Beside:
        """A field beside the truth."""
        xyz = self.points(self.cameras[0], self.grid.xy_px, False)
        true, found, sigma = xyz, field.xyz_mm, field.sigma_mm[..., :3]
        if field.uvw_mm is not None:
            u, v = self.shift_mm
            w = self._height(xyz[..., 0] + u, xyz[..., 1] + v, True)
            true, found, sigma = np.stack([np.full_like(w, u), np.full_like(w, v), w], -1), field.uvw_mm, sigma
            sigma = field.sigma_mm[..., 3:]
        valid = field.valid
        off = (found - true)[valid] / sigma[valid]
        return Beside(float(valid.mean()), np.sqrt((off**2).mean(axis=0)), float(np.abs(off).max(initial=0.0)))
