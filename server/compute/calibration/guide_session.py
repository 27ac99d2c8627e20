"""A guided acquisition in its own process: the target in live pairs, and the guidance from the views taken.

The process keeps the points and the estimate between calls; a new process finds them in the views on disk.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget, BoardView, detect_target, find_target
from stereorig.core.calibration import CalibrationOptions, CalibrationView, NominalValues
from stereorig.core.calibration.from_images import ImageOfTarget, grid_options_for, view_of
from stereorig.core.calibration.guide import Guidance, GuideOptions, Proposal, at_rest, guide, most_alike
from stereorig.core.calibration.inputs import nodes_of
from stereorig.core.errors import StereorigError, TargetError
from stereorig.core.grid import GridOptions, Localiser
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from stereorig.server.base.json_values import without_nan
from stereorig.server.base.problem import problem_of
from stereorig.server.compute.calibration.inputs import nominals_of, options_of, target_of
from stereorig.server.compute.grid_kernels import await_grid_kernels
from stereorig.server.compute.tasks import GuideTask, LookTask, Plain
from stereorig.server.formats.images import GrayImage, read_image


@dataclass
class _Session:
    """State of an acquisition in the process."""

    folder: str
    target: GridTarget | BoardTarget
    nominals: tuple[NominalValues, NominalValues]
    options: CalibrationOptions
    goal: GuideOptions
    localiser: Localiser
    rest_px: float
    seen: dict[int, list[CalibrationView]] = field(default_factory=dict)
    failed: dict[int, Plain] = field(default_factory=dict)
    guidance: Guidance | None = None
    last: tuple[int, list[Float]] | None = None


_known: dict[str, _Session] = {}
_pool: Final = ThreadPoolExecutor(max_workers=2)


def find_in_pair(task: LookTask) -> dict[str, int]:
    """Find the target in both images, by the method of the fit.

    Raises
    ------
    ImageError, TargetError
        ``camera`` names the image.
    """
    target = target_of(task.rig["target"])
    await_grid_kernels(target)
    localiser: Localiser = "paper" if task.localiser == "paper" else "profile"
    found: dict[str, int] = {}
    for cam in CAMERAS:
        options = GridOptions(saturation=task.full_scale[cam])
        try:
            view = detect_target(task.pixels[cam], target, localiser=localiser, options=options)
        except TargetError as error:
            raise type(error)(
                f"{cam}, before anything moved: {error.cause}",
                code=error.code,
                remedy=error.remedy,
                **{**error.context, "camera": cam},
            ) from error
        found[cam] = int(np.isfinite(view.xy_px).all(axis=-1).sum())
    return found


def look_at_pair(task: GuideTask, pixels: dict[str, GrayImage], serial: int) -> Plain:
    """Find the target coarsely in a live pair.

    Returns
    -------
    dict
        By camera the points found or the problem; whether the target is at rest since the last pair (``serial`` one
        less) and in a pose that is new.
    """
    session = _session(task)
    points: list[Float] = []
    cameras: dict[str, Plain] = {}
    shape = nodes_of(session.target).shape
    for cam, found in zip(CAMERAS, _pool.map(lambda c: _coarse(pixels[c], session.target), CAMERAS), strict=True):
        if isinstance(found, StereorigError):
            points.append(np.full(shape, np.nan))
            cameras[cam] = {"points_px": [], "outline_px": [], "found": 0, "problem": problem_of(found).plain()}
            continue
        points.append(found)
        some = found[np.isfinite(found).all(axis=-1)]
        hull = cv2.convexHull(some.astype(np.float32)).reshape(-1, 2)
        cameras[cam] = {
            "points_px": some.round(1).tolist(),
            "outline_px": hull.astype(np.float64).round(1).tolist(),
            "found": len(some),
            "problem": None,
        }
    seen = all(c["found"] > 0 for c in cameras.values())
    still, moved = False, float("inf")
    if session.last is not None and session.last[0] == serial - 1:
        still, moved = at_rest(session.last[1], points, limit_px=session.rest_px)
    session.last = serial, points
    like, difference = None, float("inf")
    if seen and session.guidance is not None:
        likeness = most_alike(points, session.target, session.guidance.estimate)
        like, difference = likeness.frame, likeness.difference
    return {
        "cameras": cameras,
        "seen": seen,
        "still": bool(still and seen),
        "moved_px": moved if np.isfinite(moved) else None,
        "new": bool(seen and difference >= 1.0),
        "like_view": like,
        "difference": float(difference) if np.isfinite(difference) else None,
    }


def guide_views(task: GuideTask, views: list[Plain]) -> Plain:
    """Locate the target's points in new views, and return the cover by all of them and the next view to take."""
    session = _session(task)
    numbers = sorted({int(v["index"]) for v in views})
    for k in numbers:
        if k not in session.seen and k not in session.failed:
            _add(session, k, [v for v in views if v["index"] == k])
    taken = [v for k in numbers for v in session.seen.get(k, [])]
    previous = None if session.guidance is None else session.guidance.estimate
    session.guidance = guide(taken, session.target, session.nominals, session.options, session.goal, previous=previous)
    return _plain(session, session.guidance, numbers)


def _session(task: GuideTask) -> _Session:
    session = _known.get(task.folder)
    if session is None:
        rig, plan = task.plan["rig"], task.plan
        session = _Session(
            folder=task.folder,
            target=target_of(rig["target"]),
            nominals=nominals_of(rig),
            options=options_of(rig, moves="free"),
            goal=GuideOptions(quantity=plan["quantity"], goal_um=plan["goal_um"]),
            localiser=plan["localiser"],
            rest_px=plan["rest_px"],
        )
        await_grid_kernels(session.target)
        _known.clear()
        _known[task.folder] = session
    return session


def _coarse(image: GrayImage, target: GridTarget | BoardTarget) -> Float | StereorigError:
    try:
        return find_target(image, target)
    except StereorigError as error:
        return error


def _add(session: _Session, number: int, views: list[Plain]) -> None:
    """Locate the points of one pose; if one image does not show the target, the pose does not count."""

    def located(view: Plain) -> CalibrationView:
        given = GridOptions(saturation=float(view["full_scale"]))
        options = grid_options_for(session.target, session.options, session.localiser, given)
        pixels = read_image(Path(session.folder) / view["file"])
        grid = detect_target(pixels, session.target, localiser=session.localiser, options=options)
        image = ImageOfTarget(view["camera"], None, pixels, Path(view["file"]).name, number)
        return view_of(image, grid, grid.dot_radius_mm if isinstance(grid, BoardView) else None)

    found = []
    for view, future in [(view, _pool.submit(located, view)) for view in views]:
        try:
            found.append(future.result())
        except StereorigError as error:
            problem = problem_of(error).plain()
            session.failed[number] = {**problem, "camera": view["camera"]}
    if number not in session.failed:
        session.seen[number] = found


def _plain(session: _Session, found: Guidance, numbers: list[int]) -> Plain:
    estimate, cover = found.estimate, found.coverage
    dropped = [{"view": d.frame, "camera": d.camera, "reason": d.reason} for d in estimate.dropped]
    dropped += [{"view": k, "camera": p["camera"], "reason": p["detail"]} for k, p in session.failed.items()]
    spread = found.spread
    return dict(
        without_nan(
            {
                "taken": len(numbers),
                "used": found.views,
                "left_out": sorted(dropped, key=lambda d: d["view"]),
                "coverage": {
                    "cells": {cam: cover.cells[c].astype(int).tolist() for c, cam in enumerate(CAMERAS)},
                    "share": {cam: float(cover.share[c]) for c, cam in enumerate(CAMERAS)},
                    "depth_edges": list(cover.depth_edges),
                    "depths": list(cover.depths),
                    "tilts": cover.tilts,
                },
                "adjusted": estimate.adjusted,
                "reason": estimate.reason,
                "lens": estimate.layout.form.model,
                "uncertainty": None if spread is None else {"z_um": spread.z_um, "shape_um": spread.shape_um},
                "reached": found.reached,
                "text": found.text,
                "proposal": None if found.proposal is None else _proposal(found.proposal),
            }
        )
    )


def _proposal(proposal: Proposal) -> Plain:
    pose, predicted = proposal.sys_from_target, proposal.predicted
    rotation = cv2.Rodrigues(np.asarray(pose.rotation))[0].ravel()
    return {
        "text": proposal.pose_text,
        "distance": proposal.distance,
        "tilt": proposal.tilt,
        "tilt_deg": proposal.tilt_deg,
        "part": proposal.part,
        "pose": [*np.degrees(rotation).tolist(), *pose.translation_mm.tolist()],
        "outlines_px": {cam: proposal.outlines_px[c].round(1).tolist() for c, cam in enumerate(CAMERAS)},
        "predicted": None if predicted is None else {"z_um": predicted.z_um, "shape_um": predicted.shape_um},
    }
