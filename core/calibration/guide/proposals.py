"""The next most useful view: poses that both cameras would see, each with the uncertainty after it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.layout import turned
from stereorig.core.calibration.guide.coverage import Sightline, sightline
from stereorig.core.calibration.guide.estimate import Estimate
from stereorig.core.calibration.guide.information import Information, Spread
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.errors import CalibrationError

TILTS_DEG = (20.0, 38.0)
_STEEPEST_DEG = 55.0  # to a camera's line of sight; beyond it squares and dots are too narrow to be found well
_NEARER, _FARTHER = 0.87, 1.15  # of the specimen's distance: range that a lens focused there still images sharply
_ASIDE = (0.28, 0.15)  # shares of the field of view
_BORDER = 0.01  # share of the image that stays free about the target
_REFINED = 4  # best poses in the middle that are tried in the images' other parts, too
_SIDES = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "up": (0.0, -1.0), "down": (0.0, 1.0)}
_PARTS = {
    "in the middle": (0.0, 0.0),
    "in the upper left": (-1.0, -1.0),
    "in the upper right": (1.0, -1.0),
    "in the lower left": (-1.0, 1.0),
    "in the lower right": (1.0, 1.0),
}


@dataclass(frozen=True, eq=False)
class Proposal:
    """A pose of the target that is worth a view.

    Attributes
    ----------
    sys_from_target
        The pose.
    distance, tilt, part
        ``nearer``, ``as far`` or ``farther`` than the specimen; ``none``, ``left``, ``right``, ``up`` or ``down``, the
        way in which the target's face turns as the images show it; the part of the images.
    tilt_deg
        Size of the tilt.
    outlines_px
        (2, 4, 2) the corners of the field of points in each camera's image.
    predicted
        Uncertainty over the specimen's volume with this view added; None if it is not determined.
    """

    sys_from_target: RigidTransform
    distance: str
    tilt: str
    part: str
    tilt_deg: float
    outlines_px: Float
    predicted: Spread | None = None

    @property
    def pose_text(self) -> str:
        """The pose in words."""
        where = {"nearer": "nearer", "farther": "farther away"}.get(self.distance, "as far as the specimen")
        how = "facing the cameras"
        if self.tilt != "none":
            side = {"left": "to the left", "right": "to the right", "up": "upwards", "down": "downwards"}[self.tilt]
            how = f"tilted {side} by about {self.tilt_deg:.0f} degrees"
        part = "" if self.part == "in the middle" else f", {self.part} of the images"
        return f"Hold it {where}, {how}{part}"


@dataclass(frozen=True)
class _Candidate:
    proposal: Proposal
    seen_px: tuple[Float, Float]


def propose(info: Information, sizes_px: tuple[tuple[int, int], tuple[int, int]], quantity: str) -> Proposal | None:
    """Return the pose whose view would lower the uncertainty most; None if both cameras see no pose whole.

    Parameters
    ----------
    info
        Information of the views taken.
    sizes_px
        (width, height) of each camera's image.
    quantity
        ``z`` or ``shape``.
    """
    estimate = info.estimate
    scene = _Scene(estimate, sizes_px)
    if estimate.problem.system_frame is None:
        found = scene.candidate("as far", "none", 0.0, "in the middle")
        return None if found is None else found.proposal
    rated = sorted(_rated(info, scene.in_the_middle()), key=lambda c: _value(c, quantity))
    best = [c.proposal for c in rated[:_REFINED]]
    aside = [scene.candidate(p.distance, p.tilt, p.tilt_deg, part) for p in best for part in list(_PARTS)[1:]]
    rated += _rated(info, aside)
    return min(rated, key=lambda c: _value(c, quantity)).proposal if rated else None


def _rated(info: Information, candidates: Iterable[_Candidate | None]) -> list[_Candidate]:
    """Return the candidates that both cameras see, each with the uncertainty after it if that is determined."""
    seen = [c for c in candidates if c is not None]
    added = info.of_poses([c.proposal.sys_from_target for c in seen], [c.seen_px for c in seen])
    rated = []
    for candidate, matrix in zip(seen, added, strict=True):
        try:
            spread = info.spread(matrix)
        except (CalibrationError, np.linalg.LinAlgError):
            rated.append(candidate)
        else:
            rated.append(replace(candidate, proposal=replace(candidate.proposal, predicted=spread)))
    return rated


def _value(candidate: _Candidate, quantity: str) -> float:
    predicted = candidate.proposal.predicted
    if predicted is None:
        return float("inf")
    return predicted.z_um if quantity == "z" else predicted.shape_um


class _Scene:
    """Poses about the specimen as the pair sees them."""

    def __init__(self, estimate: Estimate, sizes_px: tuple[tuple[int, int], tuple[int, int]]) -> None:
        self._sizes = sizes_px
        self._line: Sightline = sightline(estimate)
        line = self._line
        # straight as the first view was: its X axis as the images show it
        x = np.array([1.0, 0.0, 0.0])
        roll = 0.0
        if estimate.problem.system_frame is not None:
            roll = float(np.arctan2(x @ line.down, x @ line.right))
        facing = np.stack([line.right, line.down, -line.towards], axis=1)
        self._facing = facing @ turned(np.array([0.0, 0.0, roll]))
        self._points = estimate.problem.flat_nodes_mm + estimate.state.nodes_mm
        shape = estimate.problem.nodes_mm.shape[:2]
        index = np.arange(len(self._points)).reshape(shape)
        self._corners = np.array([index[0, 0], index[-1, 0], index[-1, -1], index[0, -1]])
        pair = estimate.pair
        self._cameras = pair.cam1, pair.cam2

    def in_the_middle(self) -> Iterator[_Candidate | None]:
        for distance in ("nearer", "as far", "farther"):
            yield self.candidate(distance, "none", 0.0, "in the middle")
            for size in TILTS_DEG:
                for side in _SIDES:
                    yield self.candidate(distance, side, size, "in the middle")

    def candidate(self, distance: str, tilt: str, tilt_deg: float, part: str) -> _Candidate | None:
        """Return the pose if both cameras see all of it."""
        for aside in _ASIDE if part != "in the middle" else (0.0,):
            pose = self._pose(distance, tilt, tilt_deg, part, aside)
            seen = self._seen(pose)
            if seen is not None:
                outlines = np.stack([xy[self._corners] for xy in seen])
                return _Candidate(Proposal(pose, distance, tilt, part, tilt_deg, outlines), seen)
        return None

    def _pose(self, distance: str, tilt: str, tilt_deg: float, part: str, aside: float) -> RigidTransform:
        line = self._line
        depth = line.depth_mm * {"nearer": _NEARER, "farther": _FARTHER}.get(distance, 1.0)
        place = line.eye_mm - depth * line.towards
        right, down = _PARTS[part]
        lens = self._cameras[0].lens
        focal = float(lens.image_jacobian(np.zeros((1, 2)))[0, 0, 0])
        width, height = self._sizes[0]
        place = place + aside * depth / focal * (right * width * line.right + down * height * line.down)
        rotation = self._facing
        if tilt in _SIDES:
            right, down = _SIDES[tilt]
            way = right * line.right + down * line.down
            rotation = turned(np.radians(tilt_deg) * np.cross(line.towards, way)) @ rotation
        return RigidTransform(rotation, place)

    def _seen(self, pose: RigidTransform) -> tuple[Float, Float] | None:
        points, face = pose.apply(self._points), -pose.rotation[:, 2]
        seen = []
        for camera, (width, height) in zip(self._cameras, self._sizes, strict=True):
            view = camera.centre_sys_mm - pose.translation_mm
            if face @ view < np.cos(np.radians(_STEEPEST_DEG)) * np.linalg.norm(view):
                return None
            image = camera.project(points)
            size = np.array([width, height], dtype=np.float64)
            inside = (image.xy > _BORDER * size).all(axis=-1) & (image.xy < (1.0 - _BORDER) * size - 1.0).all(axis=-1)
            if not (image.valid & inside).all():
                return None
            seen.append(image.xy)
        return seen[0], seen[1]
