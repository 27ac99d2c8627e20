"""Search in points that growth did not reach, with new seeds until nothing more matches.

Growth does not cross a step, a steep ridge or a gap. Connected groups of open points at a distance from all valid ones
get seeds of their own. A group in which no seed matches is hopeless (occluded, say) and remembered: the work is limited
by the number of groups, not by the number of their points.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool
from stereorig.core.field.growth.check import check, grow_field
from stereorig.core.field.growth.state import FieldInputs, GrowthState
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.seeding.local_search import deeper_range, depth_range, search_shapes
from stereorig.core.field.seeding.predicted import predicted_motion, seen_elsewhere
from stereorig.core.progress import raise_if_cancelled
from stereorig.core.status import PointStatus

_ROUNDS = 12
_CLEAR_SUBSETS = 0.6  # from the nearest valid point: nearer ones have been started already, or are across an edge
_PITCH_SUBSETS = 0.5  # pitch of the positions that are searched: a subset on a small face meets one of them
_A_GROUP = 24
_A_ROUND = 16  # positions, and one more for so many points of the field
_POINTS_PER_POSITION = 200
_FIELD_SHARE = 5.0  # times the field's median of 1 - zncc: limit for a match without neighbours
_CHANCE_ZNCC = 0.8  # limit that a subset of some twenty speckles reaches by chance, over all depths and tilts
_OPEN = (
    PointStatus.NOT_SEEDED,
    PointStatus.NOT_CONVERGED,
    PointStatus.LOW_CORRELATION,
    PointStatus.SIGMA_TOO_LARGE,
    PointStatus.EPIPOLAR_MISMATCH,
    PointStatus.NEIGHBOUR_MISMATCH,
)


def reach_further(inputs: FieldInputs, state: GrowthState) -> int:
    """Seed and grow into groups that growth did not reach, round after round; return the number of points added."""
    points, added = state.points, 0
    if not points.ok.any() or not _open(inputs, state).any():
        return 0
    hopeless = np.zeros(len(points.status), bool)
    for _ in range(_ROUNDS):
        raise_if_cancelled(inputs.cancel)
        label, distance = _groups(inputs, state, hopeless)
        if not label.any():
            break
        index = _positions(inputs, label, distance)
        found = _search(inputs, state, index)
        good = found.ok
        matched = np.zeros(int(label.max()) + 1, bool)
        matched[label[index[good]]] = True
        hopeless |= (label > 0) & np.isin(label, label[index]) & ~matched[label]
        hopeless[index] = True
        if not good.any():
            continue
        before = int(points.ok.sum())
        points.put(index[good], found.take(np.flatnonzero(good)))
        state.attempts.renew(_near(inputs, label, matched) & inputs.hoped_for)
        grow_field(inputs, state)
        check(inputs, points)
        gained = int(points.ok.sum()) - before
        added += gained
        if gained <= 0:
            break
    return added


def _open(inputs: FieldInputs, state: GrowthState) -> Bool:
    return np.asarray(inputs.usable & inputs.hoped_for & np.isin(state.points.status, _OPEN))


def _groups(inputs: FieldInputs, state: GrowthState, hopeless: Bool) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return (n,) the group of each open point at a distance from valid ones, 0: in none, and that distance, points."""
    shape = inputs.grid.shape
    clear = max(_CLEAR_SUBSETS * inputs.options.subset_px / inputs.grid.spacing_px, 1.0)
    distance = np.asarray(
        cv2.distanceTransform((~state.points.ok).astype(np.uint8).reshape(shape), cv2.DIST_C, 3), np.float32
    ).ravel()
    core = _open(inputs, state) & ~hopeless & (distance > clear)
    if core.any():
        core &= ~inputs.repeating
    label = cv2.connectedComponents(core.astype(np.uint8).reshape(shape), connectivity=8)[1]
    return np.asarray(label, dtype=np.int32).ravel(), distance


def _positions(inputs: FieldInputs, label: NDArray[np.int32], distance: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the points to be searched: those farthest from valid ones in the cells of each group, few in a large one.

    Such a point is in the middle of a face that growth did not reach.
    """
    core = np.flatnonzero(label > 0)
    xy, own = inputs.xy_px[core], label[core]
    size = np.bincount(own)
    pitch = max(_PITCH_SUBSETS * inputs.options.subset_px, inputs.grid.spacing_px)
    # a large group is sampled more coarsely
    cell = pitch * np.maximum(np.sqrt(size * (inputs.grid.spacing_px / pitch) ** 2 / _A_GROUP), 1.0)
    place = np.floor((xy - xy.min(axis=0)) / cell[own][:, None]).astype(np.int64)
    order = np.lexsort((-distance[core], place[:, 1], place[:, 0], own))
    key = np.stack([own, place[:, 0], place[:, 1]], axis=1)[order]
    first = np.ones(len(order), bool)
    first[1:] = (key[1:] != key[:-1]).any(axis=1)
    chosen = core[order[first]]
    most = _A_ROUND + int(inputs.usable.sum()) // _POINTS_PER_POSITION
    return np.asarray(chosen[np.argsort(-distance[chosen], kind="stable")][:most])


def _search(inputs: FieldInputs, state: GrowthState, index: NDArray[np.intp]) -> PointFits:
    points = state.points
    valid = np.flatnonzero(points.ok)
    left = 1.0 - points.quality[valid]
    low = max(min(_CHANCE_ZNCC, 1.0 - _FIELD_SHARE * float(np.median(left))), inputs.options.min_zncc)
    if state.fitter.comparisons == 3:
        return predicted_motion(state.fitter, points, inputs.xy_px, inputs.rays, index, inputs.known_w, min_zncc=low)
    seen = inputs.rays[valid], points.w[valid, 0]
    within, deeper = depth_range(inputs.pair, *seen), deeper_range(inputs.pair, *seen)
    return search_shapes(state.fitter, inputs.xy_px[index], within, min_zncc=low, deeper=deeper)


def _near(inputs: FieldInputs, label: NDArray[np.int32], matched: Bool) -> Bool:
    """Return (n,) True for the points of groups that matched, and those a subset about them."""
    of_them = matched[label] & (label > 0)
    width = 2 * int(np.ceil(inputs.options.subset_px / inputs.grid.spacing_px)) + 1
    about = cv2.dilate(of_them.astype(np.uint8).reshape(inputs.grid.shape), np.ones((width, width), np.uint8))
    return np.asarray(about).ravel() > 0


def hidden(inputs: FieldInputs, state: GrowthState) -> bool:
    """Return True if the points of a motion that are still open seem to be hidden: features would find nothing."""
    if state.fitter.comparisons == 1:
        return False
    index = np.flatnonzero(_open(inputs, state) & inputs.hoped_for)
    return not seen_elsewhere(state.fitter, state.points, inputs.xy_px, inputs.rays, index, inputs.known_w)
