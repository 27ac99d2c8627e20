"""Pictures that invite wrong matches: things in the way, highlights, blank paint, blur, another pattern, noise.

Each case spoils a pair at the reference, one at t, or both, and says where: a point is to be found again if its subset
touches no spoiled pixel in any of the four images. Places and sizes are in parts of the picture, so that they fit any.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Case:
    """Four pictures (camera 1 and 2 at the reference, then at t), and where each is spoiled.

    ``matchable`` is False where every pixel is spoiled so badly that nothing is claimed for any point.
    """

    pictures: tuple[Picture, Picture, Picture, Picture]
    spoiled: tuple[Mask, Mask, Mask, Mask]
    matchable: bool = True


@dataclass(frozen=True)
class Pictures:
    """The clean pictures, and another specimen seen by the same cameras."""

    clean: tuple[Picture, Picture, Picture, Picture]
    other: tuple[Picture, Picture]
    seed: int = 5

    @property
    def _shape(self) -> tuple[int, int]:
        return self.clean[0].shape[0], self.clean[0].shape[1]

    def _case(self, changed: dict[int, Picture], spoiled: dict[int, Mask], *, matchable: bool = True) -> Case:
        none = np.zeros(self._shape, bool)
        pictures = tuple(changed.get(k, self.clean[k]) for k in range(4))
        masks = tuple(spoiled.get(k, none) for k in range(4))
        return Case(pictures, masks, matchable)  # type: ignore[arg-type]

    def _everywhere(self, change: Callable[[Picture], Float], *, matchable: bool) -> Case:
        """Both images at t changed all over."""
        return self._case({k: _grey(change(self.clean[k])) for k in (2, 3)}, {}, matchable=matchable)

    def _over(self, where: dict[int, Mask], what: dict[int, Picture]) -> Case:
        return self._case({k: np.where(where[k], what[k], self.clean[k]) for k in where}, where)

    def occluder(self) -> Case:
        """Another speckled thing in front of both cameras at t."""
        masks = {2: _box(self._shape, 0.33, 0.27, 0.18, 0.24), 3: _box(self._shape, 0.39, 0.27, 0.18, 0.24)}
        return self._over(masks, {2: self.other[0], 3: self.other[1]})

    def occluder_one(self) -> Case:
        """The same before camera 1 only."""
        return self._over({2: _box(self._shape, 0.33, 0.27, 0.18, 0.24)}, {2: self.other[0]})

    def blank(self) -> Case:
        """Paint without speckle: grey with noise, in all four images."""
        rng = np.random.default_rng(self.seed)
        mask = _box(self._shape, 0.42, 0.36, 0.17, 0.18)
        paint = {k: _grey(128.0 + rng.normal(0.0, 2.0, self._shape)) for k in range(4)}
        return self._over(dict.fromkeys(range(4), mask), paint)

    def highlight(self) -> Case:
        """Saturated highlights that travel with the light, not with the surface."""
        return self._lit([(0.42, 0.45), (0.44, 0.44), (0.52, 0.51), (0.58, 0.47)], width=0.05, height=260.0)

    def flakes(self) -> Case:
        """Specks of 16 px in each image at t, elsewhere in each camera."""
        masks = {}
        for k in (2, 3):
            rng = np.random.default_rng(self.seed + k)
            mask = np.zeros(self._shape, np.uint8)
            for x, y in rng.uniform(
                (60, 60), (self._shape[1] - 60, self._shape[0] - 60), (round(mask.size / 2.2e4), 2)
            ):
                cv2.circle(mask, (int(x), int(y)), 8, 1, -1)
            masks[k] = mask > 0
        dark = np.full(self._shape, 40, np.uint8)
        return self._over(masks, {2: dark, 3: dark})

    def patches(self, share: float, size_px: float = 6.0) -> Case:
        """This share of the pixels of both images at t replaced by another pattern, in patches."""
        rng = np.random.default_rng(self.seed)
        masks = {}
        for k in (2, 3):
            waves = cv2.GaussianBlur(rng.normal(size=self._shape), (0, 0), size_px)
            masks[k] = np.asarray(waves > np.quantile(waves, 1.0 - share))
        return self._over(masks, {2: self.other[0], 3: self.other[1]})

    def patches_one(self, share: float) -> Case:
        """The same in camera 2 only."""
        case = self.patches(share)
        return self._case({3: case.pictures[3]}, {3: case.spoiled[3]})

    def shines_through(self, share: float) -> Case:
        """Another pattern over the whole of both images at t."""
        changed = {k: _grey((1.0 - share) * self.clean[k] + share * self.other[k - 2].astype(float)) for k in (2, 3)}
        return self._case(changed, {}, matchable=False)

    def blur(self, sd_px: float, *, matchable: bool) -> Case:
        """Both images at t out of focus."""
        return self._everywhere(lambda p: cv2.GaussianBlur(p.astype(float), (0, 0), sd_px), matchable=matchable)

    def motion_blur(self, length_px: int) -> Case:
        """Both images at t smeared along x."""
        return self._everywhere(lambda p: cv2.blur(p.astype(float), (length_px, 1)), matchable=False)

    def noise(self, sd: float) -> Case:
        """Both images at t with more noise."""
        rng = np.random.default_rng(self.seed)
        return self._everywhere(lambda p: p + rng.normal(0.0, sd, p.shape), matchable=True)

    def dead_pixels(self, share: float) -> Case:
        """Dead and hot pixels, at their own places in each camera and in both its images."""
        changed = {}
        for camera in (0, 1):
            rng = np.random.default_rng(self.seed + camera)
            dead, value = rng.random(self._shape) < share, np.where(rng.random(self._shape) < 0.5, 0, 255)
            changed |= {k: np.where(dead, value, self.clean[k]).astype(np.uint8) for k in (camera, camera + 2)}
        return self._case(changed, {})

    def fixed_pattern(self, columns: float, pixels: float) -> Case:
        """Columns and pixels that each camera adds to both its images."""
        changed = {}
        for camera in (0, 1):
            rng = np.random.default_rng(self.seed + camera)
            fixed = columns * rng.standard_normal(self._shape[1]) + pixels * rng.standard_normal(self._shape)
            changed |= {k: _grey(self.clean[k] + fixed) for k in (camera, camera + 2)}
        return self._case(changed, {})

    def overexposed(self, gain: float) -> Case:
        """Both images at t exposed so long that the bright half saturates."""
        return self._everywhere(lambda p: gain * p.astype(float), matchable=False)

    def _lit(self, positions: list[tuple[float, float]], *, width: float, height: float) -> Case:
        rows, cols = self._shape
        y, x = np.mgrid[:rows, :cols]
        light = [
            height * np.exp(-((x - u * cols) ** 2 + (y - v * rows) ** 2) / (2.0 * (width * cols) ** 2))
            for u, v in positions
        ]
        changed = {k: _grey(self.clean[k] + light[k]) for k in range(4)}
        return self._case(changed, {k: light[k] > 3.0 for k in range(4)})


def _box(shape: tuple[int, int], left: float, top: float, width: float, height: float) -> Mask:
    """A rectangle, in parts of the picture's width and height."""
    rows, cols = shape
    mask = np.zeros(shape, bool)
    mask[round(top * rows) : round((top + height) * rows), round(left * cols) : round((left + width) * cols)] = True
    return mask


def _grey(values: NDArray[np.floating] | NDArray[np.integer]) -> Picture:
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8)
