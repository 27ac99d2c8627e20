"""The calibrated volume.

The target's intersections reach up to some distance from each camera's optical axis and over some range of depths.
Beyond these, distortion and pose are extrapolated by the model. The parameters' covariance gives the uncertainty there,
too, as far as the model holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair

_MIN_POINTS = 8
_BEYOND = 0.1  # share of the depths of free poses by which the volume extends in front of and behind them


@dataclass(frozen=True, eq=False)
class CalibratedVolume:
    """Calibrated volume of a pair: in each camera's frame a truncated cone about the optical axis.

    Attributes
    ----------
    pair
        The cameras.
    slope
        (2,) largest distance from the optical axis over depth, of either camera.
    depth_mm
        (2, 2) smallest and largest depth, of either camera.
    """

    pair: StereoPair
    slope: Float
    depth_mm: Float

    def contains(self, points_mm: ArrayLike) -> Bool:
        """Return (...) True for points (..., 3) of the system frame inside both cameras' volumes; False for NaN."""
        points = np.asarray(points_mm, dtype=np.float64)
        inside = np.isfinite(points).all(axis=-1)
        for c, camera in enumerate((self.pair.cam1, self.pair.cam2)):
            p = camera.cam_from_sys.apply(points)
            depth = p[..., 2]
            with np.errstate(invalid="ignore"):
                inside &= (depth >= self.depth_mm[c, 0]) & (depth <= self.depth_mm[c, 1])
                inside &= np.hypot(p[..., 0], p[..., 1]) <= self.slope[c] * depth
        return np.asarray(inside)


def calibrated_volume(
    pair: StereoPair,
    nodes_mm: ArrayLike,
    sizes_px: Sequence[tuple[int, int]],
    positions_mm: Sequence[Sequence[float]],
    *,
    pitch_mm: float,
) -> CalibratedVolume | None:
    """Build the volume from views at stage positions, each camera moved along its optical axis.

    It ends one pitch beyond the outermost intersection that was seen, and before and behind at as much again as the
    camera travelled.

    Parameters
    ----------
    pair
        The cameras at dZ = 0.
    nodes_mm
        (n, 2) or (a, b, 2) the target's intersections, Z = 0.
    sizes_px
        (width, height) of each camera's images.
    positions_mm
        Each camera's travels dZ of the views that were fitted.
    pitch_mm
        Distance of neighbouring intersections.

    Returns
    -------
    CalibratedVolume or None
        None if a camera has too few points or distances.
    """
    seen, margins = [], []
    points = _on_plane(nodes_mm)
    for camera, size, positions in zip((pair.cam1, pair.cam2), sizes_px, positions_mm, strict=True):
        margins.append(float(np.ptp(positions)) if len(positions) else 0.0)
        parts = [_seen(camera.moved(dz), points, size) for dz in sorted(set(positions))]
        seen.append(np.concatenate(parts) if parts else np.zeros((0, 3)))
    return _volume(pair, seen, margins, pitch_mm)


def volume_of_poses(
    pair: StereoPair,
    nodes_mm: ArrayLike,
    sizes_px: Sequence[tuple[int, int]],
    cam_from_target: Sequence[Sequence[RigidTransform]],
    *,
    pitch_mm: float,
) -> CalibratedVolume | None:
    """Build the volume from the target's poses in each camera's frame, see :func:`calibrated_volume`.

    Before and behind, it ends a tenth of the seen depths beyond them.
    """
    seen, margins = [], []
    points = _on_plane(nodes_mm)
    for camera, size, poses in zip((pair.cam1, pair.cam2), sizes_px, cam_from_target, strict=True):
        parts = [_seen(Camera(camera.lens, pose), points, size) for pose in poses]
        own = np.concatenate(parts) if parts else np.zeros((0, 3))
        seen.append(own)
        margins.append(_BEYOND * float(np.ptp(own[:, 2])) if len(own) else 0.0)
    return _volume(pair, seen, margins, pitch_mm)


def _volume(
    pair: StereoPair, seen: Sequence[Float], margins_mm: Sequence[float], pitch_mm: float
) -> CalibratedVolume | None:
    slope, depth = np.empty(2), np.empty((2, 2))
    for c, (own, margin) in enumerate(zip(seen, margins_mm, strict=True)):
        if not margin > 0.0 or len(own) < _MIN_POINTS:
            return None
        slope[c] = ((np.hypot(own[:, 0], own[:, 1]) + pitch_mm) / own[:, 2]).max()
        depth[c] = own[:, 2].min() - margin, own[:, 2].max() + margin
    return CalibratedVolume(pair, slope, depth)


def _on_plane(nodes_mm: ArrayLike) -> Float:
    nodes = np.asarray(nodes_mm, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([nodes, np.zeros(len(nodes))])


def _seen(camera: Camera, points: Float, size: tuple[int, int]) -> Float:
    """Camera coordinates of the points that are in the image."""
    image = camera.project(points)
    inside = image.valid & (image.xy >= 0.0).all(axis=-1) & (image.xy <= np.array(size) - 1.0).all(axis=-1)
    return np.asarray(camera.cam_from_sys.apply(points)[inside])
