"""The adjustment with bad views and points of free poses left out, each with its reason.

Stage positions are few and each is needed; their errors are named elsewhere. Free poses are many: a view with much
larger residuals than the others is dropped, and such a point is left out of its view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.adjust import NOISE_ROUNDS, Adjustment, adjust
from stereorig.core.calibration.fit.dots import dot_offsets_px
from stereorig.core.calibration.fit.free_start import MIN_POSES
from stereorig.core.calibration.fit.layout import Layout, State, camera_of, camera_seeing
from stereorig.core.calibration.fit.model import linearise_all
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.calibration.fit.problem import FitData, rebased, restricted
from stereorig.core.calibration.inputs import CalibrationView
from stereorig.core.errors import CalibrationInputError
from stereorig.core.names import CAMERAS
from stereorig.core.robust import MAD_TO_SIGMA

_BAD_VIEW = 4.0  # multiple of the median view's rms residual over its noise
_WELL_FOUND_PX = 0.03  # a third of a good view's residual: no view with points this near is blurred or bent
_BAD_POINT = 7.0  # robust standard deviations of its own view
_MAX_BAD_POINTS = 0.2  # share of a view's points; with more bad points the whole view counts as bad
_ROUNDS = 6
_DOT_ROUNDS = 2


@dataclass(frozen=True)
class DroppedView:
    """A view that was left out, and why."""

    name: str
    camera: str
    frame: int
    reason: str


@dataclass(frozen=True)
class Screened:
    """The minimum over the views that hold.

    Attributes
    ----------
    problem
        With these views only.
    rows
        Their rows, bad points taken out, dots' centres corrected.
    adjustment
        The minimum.
    dropped
        The other views.
    """

    problem: FitData
    rows: tuple[ViewRows, ...]
    adjustment: Adjustment
    dropped: tuple[DroppedView, ...]


def fit_screened(
    problem: FitData,
    layout: Layout,
    start: State,
    odd: Sequence[int] = (),
    *,
    noise_px: Float | None = None,
    rounds: int = NOISE_ROUNDS,
) -> Screened:
    """Adjust, leaving out bad views and points of free poses.

    Parameters
    ----------
    problem, layout, start
        The views, their unknowns, and start values.
    odd
        Free poses that did not fit the cameras' relative pose from the start.
    noise_px, rounds
        See :func:`stereorig.core.calibration.fit.adjust.adjust`.

    Raises
    ------
    CalibrationInputError
        ``too_few_poses`` if too few views hold.
    CalibrationError
        As :func:`stereorig.core.calibration.fit.adjust.adjust`.
    """
    dropped = not_of_one_pose(problem.views, odd)
    outside = [v for v in problem.views if v.frame is not None and v.frame in odd]
    lost = [v for v in problem.views if v.frame is not None and v not in outside and not _known(v, problem, start)]
    dropped += [
        DroppedView(v.label, v.camera, int(v.frame or 0), "no pose of the target fits its points") for v in lost
    ]
    current = _without(problem, [*outside, *lost])
    if current is not problem:
        layout, start = _follow(problem, current, layout, start)
    excluded: dict[str, Float] = {}
    state = start
    adjustment: Adjustment | None = None
    rows: list[ViewRows] = []
    noise = noise_px

    def adjusted() -> Adjustment:
        return adjust(
            layout,
            state,
            rows,
            current.flat_nodes_mm,
            current.priors(layout),
            max_iterations=current.options.max_iterations,
            noise_px=noise,
            rounds=rounds,
        )

    for _ in range(_ROUNDS):
        rows = _rows(current, layout, state, excluded, corrected=adjustment is not None)
        adjustment = adjusted()
        state, noise = adjustment.state, adjustment.noise_px
        bad, points = _bad(current, rows, adjustment)
        if not bad and not points:
            break
        for label, mask in points.items():
            excluded[label] = np.maximum(mask, excluded.get(label, mask))
        for view, reason in bad:
            dropped.append(DroppedView(view.label, view.camera, int(view.frame or 0), reason))
        if bad:
            left = _without(current, [v for v, _ in bad])
            layout, state = _follow(current, left, layout, state)
            current, noise = left, None
    for _ in range(_DOT_ROUNDS if any(v.dot_radius_mm for v in current.views) else 0):
        rows = _rows(current, layout, state, excluded, corrected=True)
        adjustment = adjusted()
        state, noise = adjustment.state, adjustment.noise_px
    assert adjustment is not None
    return Screened(current, tuple(rows), adjustment, tuple(dropped))


def not_of_one_pose(views: Sequence[CalibrationView], frames: Sequence[int]) -> list[DroppedView]:
    """Return the views of free poses that the cameras saw differently, as left out."""
    out = []
    for v in views:
        if v.frame is not None and v.frame in frames:
            pair = " and ".join(o.label for name in CAMERAS for o in views if o.frame == v.frame and o.camera == name)
            reason = f"{pair} do not show one pose: the target moved between the exposures"
            out.append(DroppedView(v.label, v.camera, v.frame, reason))
    return out


def points_mm(problem: FitData, layout: Layout, state: State) -> Float:
    """Points (n, 3) of the target as a state has them: with the pitch's scale and the nodes' corrections."""
    return np.asarray(problem.flat_nodes_mm * (1.0 + state.x[layout.pitch_scale]) + state.nodes_mm)


def _known(view: CalibrationView, problem: FitData, state: State) -> bool:
    return view.frame == problem.system_frame or view.frame in state.sys_from_target


def _without(problem: FitData, views: Sequence[CalibrationView]) -> FitData:
    if not views:
        return problem
    left = problem.without(views)
    if not left.staged and not left.cameras_held:
        frames = [{v.frame for v in left.views if v.camera == name} for name in CAMERAS]
        both = len(frames[0] & frames[1])
        if both < MIN_POSES:
            raise CalibrationInputError(
                f"Only {both} poses are left whose points both cameras' images fit; {MIN_POSES} are needed.",
                code="too_few_poses",
                remedy="Take sharp views of the target at rest, both cameras at the same instant.",
            )
    return left


def _follow(problem: FitData, left: FitData, layout: Layout, state: State) -> tuple[Layout, State]:
    """Layout and state of a problem with fewer views."""
    if left.system_frame != problem.system_frame and left.system_frame is not None:
        state = rebased(state, layout, left.system_frame)
    other = left.layout(layout.form.model)
    return other, restricted(state, layout, other)


def _rows(
    problem: FitData, layout: Layout, state: State, excluded: dict[str, Float], *, corrected: bool
) -> list[ViewRows]:
    out = []
    for view, row in zip(problem.views, problem.rows, strict=True):
        if corrected and view.dot_radius_mm:
            camera = camera_seeing(layout, state, row.camera, row.dz_mm, row.frame)
            row = row.moved(-dot_offsets_px(camera, points_mm(problem, layout, state), view.dot_radius_mm))
        if view.label in excluded:
            row = row.without(excluded[view.label].astype(bool))
        out.append(row)
    return out


def view_sizes(problem: FitData, rows: Sequence[ViewRows], adjustment: Adjustment) -> tuple[Float, list[Float]]:
    """Return the residuals' lengths over the noise: of each view their rms, and (n,) of its points."""
    rms, sizes = np.zeros(len(rows)), []
    lins = linearise_all(adjustment.layout, adjustment.state, rows, problem.flat_nodes_mm)
    for k, (row, lin) in enumerate(zip(rows, lins, strict=True)):
        size = np.sqrt(row.weight) * np.linalg.norm(lin.residual_px, axis=1) / adjustment.noise_px[row.camera]
        sizes.append(size)
        rms[k] = np.sqrt(np.mean(size[row.found] ** 2)) if row.found.any() else np.inf
    return rms, sizes


def _bad(
    problem: FitData, rows: Sequence[ViewRows], adjustment: Adjustment
) -> tuple[list[tuple[CalibrationView, str]], dict[str, Float]]:
    """Return free poses with large residuals, with the reason, and points to leave out of the others."""
    rms, sizes = view_sizes(problem, rows, adjustment)
    free = np.array([row.frame is not None for row in rows])
    if not free.any():
        return [], {}
    typical = float(np.median(rms[free]))
    bad: list[tuple[CalibrationView, str]] = []
    points: dict[str, Float] = {}
    for k in map(int, np.flatnonzero(free)):
        row, view = rows[k], problem.views[k]
        px = float(rms[k] * adjustment.noise_px[row.camera])
        own = sizes[k][row.found]
        robust = MAD_TO_SIGMA * float(np.median(own)) / 1.2  # median of a Rayleigh length over its sigma
        outlying = row.found & (sizes[k] > _BAD_POINT * max(robust, 0.5 * typical))
        few = 0 < outlying.sum() <= _MAX_BAD_POINTS * row.found.sum()
        # at the rim of a wide lens a pixel may have no ray under the fitted lens: such a point cannot be judged
        lens = camera_of(adjustment.layout, adjustment.state.x, row.camera).lens
        no_ray = row.found & ~lens.normalised_from_image(row.xy_px).valid
        if few or no_ray.any():
            points[view.label] = (no_ray | outlying if few else no_ray).astype(np.float64)
        elif rms[k] > _BAD_VIEW * typical and px > _WELL_FOUND_PX:
            bad.append(
                (
                    view,
                    f"its points lie {px:.2f} px off, {rms[k] / typical:.0f} times as far as in the other views: "
                    "blurred by motion, wrongly found, or the target was bent",
                )
            )
    if bad:
        # the worst spoil the others: take out those near the worst, look again at the rest
        worst = max(float(rms[problem.views.index(v)]) for v, _ in bad)
        bad = [(v, r) for v, r in bad if rms[problem.views.index(v)] > 0.3 * worst]
    return bad, points
