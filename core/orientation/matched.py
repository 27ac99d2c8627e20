"""Matched points of both images, taken from a measured field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import SpacePoints
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.robust import spread_indices

_STEP_PX = 0.01


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Points seen in both images of one or several steps.

    Attributes
    ----------
    xy1_px, xy2_px
        (n, 2) in camera 1 and camera 2.
    step
        (n,) number of the image pair, from 0.
    subset_px
        Width of the subsets that were matched; 0 for points that have none, and share no pixels.
    """

    xy1_px: Float
    xy2_px: Float
    step: NDArray[np.int32]
    subset_px: int = 0

    @staticmethod
    def of(xy1_px: Float, xy2_px: Float, step: int = 0, *, subset_px: int = 0) -> MatchedPoints:
        """Return the points of one pair of images."""
        return MatchedPoints(xy1_px, xy2_px, np.full(len(xy1_px), step, np.int32), subset_px)

    @staticmethod
    def joined(parts: Sequence[MatchedPoints]) -> MatchedPoints:
        """Return the points of several pairs of images, matched with subsets of one width."""
        xy1, xy2, step = (np.concatenate([getattr(p, a) for p in parts]) for a in ("xy1_px", "xy2_px", "step"))
        return MatchedPoints(xy1, xy2, step, parts[0].subset_px)

    def at(self, which: NDArray[np.bool_]) -> MatchedPoints:
        """Return some of the points, (n,) True."""
        return replace(self, xy1_px=self.xy1_px[which], xy2_px=self.xy2_px[which], step=self.step[which])


def matched_points(
    pair: StereoPair, shape: Field, subset_px: int, step: int = 0, *, at_most: int | None = None
) -> MatchedPoints:
    """Return the valid points of a shape as they were matched.

    Parameters
    ----------
    pair
        The cameras that the shape was measured with.
    shape
        Reference positions and epipolar offsets.
    subset_px
        Width of its subsets.
    step
        Number of its images.
    at_most
        Number of points, spread over all, that are enough; all of them if left out.
    """
    ok = np.flatnonzero(shape.valid & np.isfinite(shape.epipolar_px))
    if at_most is not None and len(ok) > 0:
        ok = ok[np.unique(spread_indices(len(ok), at_most))]
    xy1 = np.stack([shape.x_px.ravel()[ok], shape.y_px.ravel()[ok]], axis=1)
    xyz, offset = shape.xyz_mm.reshape(-1, 3)[ok], shape.epipolar_px.ravel()[ok]
    xy2 = seen_by_camera2(pair, pair.cam1.rays_cam(xy1), xyz, offset)
    return MatchedPoints.of(xy1, xy2, step, subset_px=subset_px)


def seen_by_camera2(pair: StereoPair, ray1: SpacePoints, xyz_mm: Float, offset_px: Float) -> Float:
    """Return positions (n, 2) in camera 2 of measured points: off the epipolar lines of ``ray1`` by the offset."""
    on_line = pair.cam2.project(xyz_mm).xy
    across = across_line(pair, ray1, on_line)
    left = offset_px - pair.epipolar_residual_of_rays(ray1, pair.cam2.rays_cam(on_line))
    return np.asarray(on_line + across * (left / (across**2).sum(axis=1))[:, None])


def across_line(pair: StereoPair, ray1: SpacePoints, xy2_px: Float) -> Float:
    """Return (n, 2) the gradient of the epipolar offset over the position in camera 2: across the line of ``ray1``."""
    h = _STEP_PX
    ends = np.array([[h, 0.0], [-h, 0.0], [0.0, h], [0.0, -h]])[:, None]
    right, left, below, above = pair.epipolar_residual_of_rays(ray1, pair.cam2.rays_cam(xy2_px + ends))
    return np.stack([right - left, below - above], axis=1) / (2 * h)
