"""A plate that is blurred at t in both cameras, by the renderer of reliefs, and its displacement beside the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.settings import PatchSetting
from tests.support.relief_parts import calibrated
from tests.support.relief_rig import Body, Optics, Texture, exposed, picture, truth, two_cameras

SPACING_PX = 10
_TILT_RAD, _TURN_RAD = 0.1, 0.01
_MARGIN_PX = 30


@dataclass(frozen=True)
class Beside:
    """A measured displacement beside the truth.

    Attributes
    ----------
    valid
        Share of valid points.
    ratio
        (3,) root mean square over the valid points of the errors of u, v, w over their reported standard deviation.
    worst
        Largest of these.
    """

    valid: float
    ratio: NDArray[np.float64]
    worst: float


@dataclass(frozen=True, eq=False)
class BlurredPlate:
    """A tilted plate that is turned, strained and moved; at t both cameras are out of focus."""

    texture: Texture
    size: tuple[int, int] = (640, 512)
    samples: int = 24

    @cached_property
    def _bodies(self) -> tuple[Body, Body]:
        c, s = np.cos(_TILT_RAD), np.sin(_TILT_RAD)
        body = Body(texture=self.texture).moved(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), np.zeros(3))
        axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
        cross = np.cross(axis, np.eye(3)).T
        turned = np.eye(3) + np.sin(_TURN_RAD) * cross + (1.0 - np.cos(_TURN_RAD)) * cross @ cross
        strained = np.eye(3) + np.array([[1e-3, 3e-4, 0.0], [3e-4, -5e-4, 0.0], [0.0, 0.0, 0.0]])
        return body, body.moved(turned @ strained, np.array([0.083, -0.147, 0.21]))

    @cached_property
    def cameras(self):  # type: ignore[no-untyped-def]
        """The cameras."""
        return two_cameras(self.size)

    @cached_property
    def pair(self) -> StereoPair:
        """Their calibration."""
        return calibrated(self.cameras)

    @cached_property
    def clean(self) -> list[NDArray[np.float64]]:
        """Both cameras at the reference, then both at t, in focus and without noise."""
        optics = Optics(samples=self.samples)
        return [picture(camera, (body,), optics) for body in self._bodies for camera in self.cameras]

    @cached_property
    def grid(self) -> PointGrid:
        """The points that are measured."""
        w, h = self.size
        return PointGrid.rectangle(_MARGIN_PX, _MARGIN_PX, w - _MARGIN_PX, h - _MARGIN_PX, spacing_px=SPACING_PX)

    @cached_property
    def true_mm(self) -> NDArray[np.float64]:
        """(r, c, 3) displacements."""
        before, after = self._bodies
        xy = np.stack([self.grid.x_px, self.grid.y_px], axis=-1)
        return truth(self.cameras, (before,), xy, subset_px=3, moved=(after,)).uvw_mm

    def measured(
        self, blur_px: float, noise: float, subset_px: int, *, patch: PatchSetting = "affine", seed: int = 0
    ) -> Beside:
        """Blur the pictures at t by a Gaussian of this standard deviation, add noise, measure."""
        rng = np.random.default_rng(seed)
        blurred = [
            image if k < 2 or blur_px == 0.0 else gaussian_filter(image, blur_px, truncate=6.0)
            for k, image in enumerate(self.clean)
        ]
        images = [exposed(image, noise, rng) for image in blurred]
        options = MeasureOptions(subset_px=subset_px, patch=patch)
        field = ReferencePair(self.pair, *images[:2]).motion(*images[2:], self.grid, options)
        v = field.valid
        if not v.any():
            return Beside(0.0, np.full(3, np.nan), np.nan)
        assert field.uvw_mm is not None
        off = (field.uvw_mm - self.true_mm)[v] / field.sigma_mm[v][:, 3:]
        return Beside(float(v.mean()), np.sqrt((off**2).mean(axis=0)), float(np.abs(off).max()))
