"""One camera's ten parameters by Levenberg-Marquardt, Eq. (11), from nominal values only."""

from __future__ import annotations

import numpy as np

from core.arrays import Float
from core.calibration.fit.model import Observations, linearise
from core.calibration.inputs import NominalCamera
from core.errors import CalibrationError

_OUTSIDE_PX = 1e6  # residual of a point that has no image, so that a step there is never taken


def fit_single(
    obs: Observations, nodes_mm: Float, nominal: NominalCamera, starts: list[Float], *, centre_sigma_px: float
) -> Float:
    """Fit one camera on the nominal grid; the best of the minima reached from several starts.

    Parameters
    ----------
    obs
        The fitted views.
    nodes_mm
        (n, 2) grid positions.
    nominal
        Gives the aspect ratio and the centre of the prior.
    starts
        Start values, (10,) each.
    centre_sigma_px
        Prior on the image centre; its weight here assumes a noise of 0.05 px and is settled in the adjustment of
        both cameras.

    Returns
    -------
    Float
        (10,) parameters.

    Raises
    ------
    CalibrationError
        Code ``calibration_not_converged`` if no start leads to a finite minimum.
    """
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    root_weight = np.sqrt(obs.weight)[..., None]
    prior_weight = 0.05 / centre_sigma_px
    centre = np.array(nominal.centre_px)

    def residuals(p: Float) -> Float:
        lin = linearise(np.concatenate([p, [0.0, 0.0]]), nominal.aspect, nodes_mm, obs)
        body = (lin.residual_px * root_weight)[obs.found].ravel()
        if not lin.valid or not np.isfinite(body).all():
            body = np.full_like(body, _OUTSIDE_PX)
        return np.concatenate([body, (centre - p[1:3]) * prior_weight])

    def jacobian(p: Float) -> Float:
        lin = linearise(np.concatenate([p, [0.0, 0.0]]), nominal.aspect, nodes_mm, obs)
        body = -(lin.by_camera[..., :10] * root_weight[..., None])[obs.found].reshape(-1, 10)
        prior = np.zeros((2, 10))
        prior[[0, 1], [1, 2]] = -prior_weight
        return np.concatenate([body, prior])

    best: Float | None = None
    best_cost = np.inf
    for start in starts:
        if not linearise(np.concatenate([start, [0.0, 0.0]]), nominal.aspect, nodes_mm, obs).valid:
            continue
        found = least_squares(
            residuals, start, jac=jacobian, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=400
        )
        if np.isfinite(found.x).all() and found.cost < best_cost and found.x[0] > 0.0 and found.x[9] > 0.0:
            best, best_cost = np.asarray(found.x, dtype=np.float64), float(found.cost)
    if best is None:
        raise CalibrationError(
            f"No start from phd {nominal.phd_px:g} px, standoff {nominal.standoff_mm:g} mm and angle "
            f"{nominal.angle_deg:g} degrees led to a minimum.",
            code="calibration_not_converged",
        )
    return best
