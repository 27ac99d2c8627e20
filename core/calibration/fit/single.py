"""One camera by itself from the views of a stage, Eq. (11), by Levenberg-Marquardt from nominal values only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.layout import Layout, State
from stereorig.core.calibration.fit.model import linearise_all
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.calibration.inputs import NominalValues
from stereorig.core.errors import CalibrationError

_OUTSIDE_PX = 1e6  # residual of a point that has no image, so that a step there is never taken
_DIRECTION_PRIOR_PX = 0.05 / 0.5  # over the prior's radians; settled in the adjustment of both cameras


def fit_single(
    layout: Layout,
    c: int,
    views: Sequence[ViewRows],
    nodes_mm: Float,
    nominal: NominalValues,
    start_poses: Sequence[Float],
    *,
    centre_sigma_px: float,
) -> tuple[Float, Float]:
    """Fit one camera on the nominal target; the best of the minima reached from several starts.

    Parameters
    ----------
    layout
        With the paper's lens.
    c
        The camera, 0 or 1.
    views
        Its fitted views at stage positions.
    nodes_mm
        (n, 3) nominal points.
    nominal
        Gives the start of the lens, the aspect ratio, and the centre of the prior.
    start_poses
        Poses (6,) to start from.
    centre_sigma_px
        Prior on the image centre; its weight here assumes a noise of 0.05 px and is settled in the adjustment of
        both cameras.

    Returns
    -------
    lens_and_pose, direction
        (11,) lens and pose, and (2,) the direction of a single stage.

    Raises
    ------
    CalibrationError
        Code ``calibration_not_converged`` if no start leads to a finite minimum.
    """
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    single = layout.moves != "cameras"
    lens, pose = layout.lens(c), layout.pose(c)
    unknowns = [*range(lens.start, lens.stop - 1), *range(pose.start, pose.stop)]
    unknowns += list(range(layout.direction.start, layout.direction.stop)) if single else []
    index = np.array(unknowns)
    prior_weight = 0.05 / centre_sigma_px
    centre = np.array(nominal.centre_px)
    roots = [np.sqrt(v.weight)[:, None] for v in views]
    empty = np.zeros_like(nodes_mm)

    def state_of(p: Float) -> State:
        x = np.zeros(layout.size)
        x[lens.stop - 1] = nominal.aspect
        x[index] = p
        return State(x, {}, empty)

    def residuals(p: Float) -> Float:
        lins = linearise_all(layout, state_of(p), views, nodes_mm)
        body = np.concatenate(
            [(lin.residual_px * r)[v.found].ravel() for lin, r, v in zip(lins, roots, views, strict=True)]
        )
        if not all(lin.valid for lin in lins) or not np.isfinite(body).all():
            body = np.full_like(body, _OUTSIDE_PX)
        extra = [(centre - p[1:3]) * prior_weight]
        if single:
            extra.append(-p[10:] * _DIRECTION_PRIOR_PX)
        return np.concatenate([body, *extra])

    def jacobian(p: Float) -> Float:
        rows = []
        for v, r, lin in zip(views, roots, linearise_all(layout, state_of(p), views, nodes_mm), strict=True):
            full = np.zeros((len(v.found), 2, layout.size))
            full[..., lin.columns] = lin.by_unknown
            rows.append(-(full[..., index] * r[..., None])[v.found].reshape(-1, len(index)))
        prior = np.zeros((4 if single else 2, len(index)))
        prior[[0, 1], [1, 2]] = -prior_weight
        if single:
            prior[[2, 3], [10, 11]] = -_DIRECTION_PRIOR_PX
        return np.concatenate([*rows, prior])

    best: Float | None = None
    best_cost = np.inf
    cx, cy = nominal.centre_px
    for start_pose in start_poses:
        start = np.concatenate([[nominal.phd_px, cx, cy, 0.0], start_pose, np.zeros(2 if single else 0)])
        if not all(lin.valid for lin in linearise_all(layout, state_of(start), views, nodes_mm)):
            continue
        found = least_squares(
            residuals, start, jac=jacobian, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=400
        )
        upright = np.isfinite(found.x).all() and found.x[0] > 0.0 and found.x[9] > 0.0
        if upright and found.cost < best_cost:
            best, best_cost = np.asarray(found.x, dtype=np.float64), float(found.cost)
    if best is None:
        raise CalibrationError(
            f"No start from phd {nominal.phd_px:g} px, standoff {nominal.standoff_mm:g} mm and angle "
            f"{nominal.angle_deg:g} degrees led to a minimum.",
            code="calibration_not_converged",
        )
    lens_and_pose = np.concatenate([best[:4], [nominal.aspect], best[4:10]])
    return lens_and_pose, best[10:12] if single else np.zeros(2)
