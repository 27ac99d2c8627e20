"""A pair of detections as they come from live images: whether the target is at rest, and whether its pose is new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.free_start import pose_of
from stereorig.core.calibration.guide.estimate import Estimate
from stereorig.core.calibration.inputs import AnyTarget, CalibrationView, extent_mm, nodes_of
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.names import CAMERAS

REST_PX = 1.0
_NEW_TURN_RAD = np.radians(8.0)  # a pose is known to a small part of a degree; a turn of 8 shows more of the lens
_NEW_SHIFT = 0.12  # share of the target's extent, across the line of sight
_NEW_DEPTH = 0.06  # share of the distance


@dataclass(frozen=True)
class Likeness:
    """The taken pose that is most similar to a new one.

    Attributes
    ----------
    frame
        Its number; None without any pose taken.
    difference
        Difference of both poses, 1 if they are just different enough: the largest of turn, shift and distance, each
        relative to the least difference of a new pose. Infinite without any.
    """

    frame: int | None
    difference: float

    @property
    def new(self) -> bool:
        """True where the pose differs enough from every one taken."""
        return self.difference >= 1.0


def at_rest(earlier_px: Sequence[Float], now_px: Sequence[Float], *, limit_px: float = REST_PX) -> tuple[bool, float]:
    """Return True if the target did not move between two successive detections, and its move.

    Parameters
    ----------
    earlier_px, now_px
        (n_a, n_b, 2) points in each camera, NaN where not found. Coarse positions are half a pixel off each by itself;
        the median length of the moves of all is not.
    limit_px
        Largest median move. At five pairs a second one pixel is 5 px/s: within an exposure of 10 ms a view is blurred
        by a twentieth of a pixel.

    Returns
    -------
    still, moved_px
        Move in the camera that saw the larger one; infinite if the target was not found both times.
    """
    moves = []
    for before, after in zip(earlier_px, now_px, strict=True):
        if before.shape != after.shape:
            return False, float("inf")
        length = np.linalg.norm(after - before, axis=-1)
        length = length[np.isfinite(length)]
        moves.append(float(np.median(length)) if len(length) else float("inf"))
    worst = max(moves)
    return worst <= limit_px, worst


def pose_seen(points_px: Sequence[Float], nodes_mm: Float, estimate: Estimate) -> RigidTransform | None:
    """Pose of the target in camera 1's frame by a pair of detections, None if the points do not give one."""
    pair = estimate.pair
    for c, (name, camera) in enumerate(zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)):
        if int(np.isfinite(points_px[c]).all(axis=-1).sum()) < 6:
            continue
        pose = pose_of(CalibrationView(name, None, points_px[c], frame=0), nodes_mm, camera.lens)
        if pose is not None:
            return pose if c == 0 else pair.cam2_from_cam1.inverse() @ pose
    return None


def most_alike(points_px: Sequence[Float], target: AnyTarget, estimate: Estimate) -> Likeness:
    """Compare a pair of detections with the poses taken.

    Parameters
    ----------
    points_px
        (n_a, n_b, 2) points in each camera, NaN where not found; coarse ones do.
    target
        The target.
    estimate
        Estimate of the views taken.
    """
    poses = estimate.cam1_from_target
    pose = pose_seen(points_px, nodes_of(target), estimate)
    if pose is None or not poses:
        return Likeness(None, float("inf") if not poses else 0.0)
    return _nearest(pose, poses, extent_mm(target))


def _nearest(pose: RigidTransform, poses: Mapping[int, RigidTransform], extent: float) -> Likeness:
    best = Likeness(None, float("inf"))
    for k, other in poses.items():
        # turns about the target's own normal count as well: they move its errors over the lens
        cosine = np.clip(0.5 * (np.trace(pose.rotation.T @ other.rotation) - 1.0), -1.0, 1.0)
        here, there = pose.translation_mm, other.translation_mm
        across = float(np.linalg.norm(here[:2] / here[2] - there[:2] / there[2])) * float(there[2])
        difference = max(
            float(np.arccos(cosine)) / _NEW_TURN_RAD,
            across / (_NEW_SHIFT * extent),
            abs(float(np.log(here[2] / there[2]))) / _NEW_DEPTH,
        )
        if difference < best.difference:
            best = Likeness(k, difference)
    return best
