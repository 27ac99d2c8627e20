"""Images that were exchanged: poses whose views fit crosswise, cameras with each other's pinhole distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from stereorig.core.calibration.checks.measures import focal_lengths_px
from stereorig.core.calibration.choice.screening import DroppedView
from stereorig.core.calibration.inputs import CalibrationView, NominalValues
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

_ONE_POSE_PX = 0.3  # residual of an RBE view that is still usable
_MOST_POSES = 12  # poses left out that are compared; with more the comparison of all pairs would take long
_OFF = 0.2  # logarithm of found over declared pinhole distance; declared ones are good to some tens of percent
_CROSSED = 0.3  # share of that logarithm, with the other camera's declaration


def name_exchanged(
    dropped: Sequence[DroppedView], views: Sequence[Sequence[CalibrationView]], pair: StereoPair
) -> tuple[DroppedView, ...]:
    """Return the views left out, with the reason of those that two poses of one camera exchanged."""
    names = {view.name for view in dropped}
    one, two = ({v.frame: v for v in own if v.frame is not None and v.label in names} for own in views)
    reasons: dict[str, str] = {}
    for k, m in combinations(sorted(set(one) & set(two))[:_MOST_POSES], 2):
        if _of_one_pose(one[k], two[m], pair) and _of_one_pose(one[m], two[k], pair):
            own = f"{one[k].label} and {one[m].label}, or {two[k].label} and {two[m].label}, are swapped"
            reasons |= {v.label: own for v in (one[k], one[m], two[k], two[m])}
    return tuple(replace(view, reason=reasons.get(view.name, view.reason)) for view in dropped)


def _of_one_pose(one: CalibrationView, two: CalibrationView, pair: StereoPair) -> bool:
    both = one.found & two.found
    if not both.any():
        return False
    xy = one.xy_px[both], two.xy_px[both]
    space = pair.triangulate(*xy).xyz_mm
    off = [camera.project(space).xy - seen for camera, seen in zip((pair.cam1, pair.cam2), xy, strict=True)]
    return bool(np.sqrt(np.mean(np.square(off))) < _ONE_POSE_PX)


def remark_on_distances(pair: StereoPair, nominals: Sequence[NominalValues]) -> list[str]:
    """Remark on pinhole distances that are far from the declared ones, and on those that fit the other camera's."""
    found = np.array([focal_lengths_px(camera.lens)[0] for camera in (pair.cam1, pair.cam2)])
    declared = np.array([nominal.phd_px for nominal in nominals])
    off, crossed = np.abs(np.log(found / declared)), np.abs(np.log(found / declared[::-1]))
    if not off.max() > _OFF:
        return []
    if crossed.max() < _CROSSED * off.max():
        return [
            f"The pinhole distances found, {found[0]:.0f} and {found[1]:.0f} px, are those declared of the other one:"
            " the names of the cameras' images seem exchanged."
        ]
    return [
        f"The pinhole distance of {name} is {f:.0f} px, {100.0 * abs(f / d - 1.0):.0f} % off the declared {d:g} px: "
        "check the declaration, and which camera took which images."
        for name, f, d, o in zip(CAMERAS, found, declared, off, strict=True)
        if o > _OFF
    ]
