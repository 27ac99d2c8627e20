"""All cameras, motions, poses and nodes in one adjustment, Eq. (11), by Levenberg-Marquardt.

Priors enter as observations: the image centre, the stages' axes, scales and steps, the pitch, and the nodes' tolerance,
which also fixes the freedoms that camera poses and node corrections share.

An axis' tilt is held at its prior's mean unless the views show one, and is carried into the covariance whole. A tilt
moves the centre; its remaining effect on the images is decentring, the product of the centre's shift and a distortion
that the target's errors may have caused. A fit of both treats that distortion as true, explains more of the target's
errors by the tilt, and states a covariance as if the views had determined the tilt: lengths were 1.3 times worse and
their stated uncertainty too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.layout import Layout, Priors, State
from stereorig.core.calibration.fit.normal import Covariance, Normal, assemble, covariance, prior_part
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.errors import CalibrationError
from stereorig.core.names import Cause

NOISE_ROUNDS = 4
_MIN_NOISE_PX = 1e-4  # no localiser is better; keeps noise-free observations and loose priors in one system
_LAST, _NEAR = 10, 0.1  # last steps, and the gain that they may still have: a tenth of one standard deviation's cost
_LENS_AND_POSE = 10.0  # unknowns of a camera that correlated observations feel
# gain of both axes' tilts in the sum of squares that counts as shown: chance reaches it once in a hundred (4 unknowns)
_SHOWN_TILT = 13.28
# or this share of the prior's standard deviation is left in the direction that the views determine best: with a lens
# that surely distorts, or a field wide enough, they determine the tilt better than the prior does
_LEFT_TILT = 0.5
_SURE = 2.0  # standard deviations of a distortion that may be the target's errors


@dataclass(frozen=True)
class Adjustment:
    """Minimum of the adjustment.

    Attributes
    ----------
    layout, state, priors
        The unknowns, their values and their priors.
    covariance
        (m, m) of the unknowns, zero for held ones.
    by_prior
        (m, m) parts of it by the priors of the stage and of the target. The rest is the views' noise. All else is the
        views' noise.
    node_sigma_mm
        (n, k) of the nodes' corrections, k of X, Y, Z.
    noise_px
        (2,) estimated standard deviation per coordinate and camera.
    redundancy
        (2,) observations beyond the unknowns, per camera.
    cost
        Weighted squares of residuals and priors.
    iterations
        Steps taken.
    """

    layout: Layout
    state: State
    priors: Priors
    covariance: Float
    by_prior: dict[Cause, Float]
    node_sigma_mm: Float
    noise_px: Float
    redundancy: Float
    cost: float
    iterations: int


def adjust(
    layout: Layout,
    start: State,
    views: Sequence[ViewRows],
    nominal_nodes_mm: Float,
    priors: Priors,
    *,
    max_iterations: int,
    noise_px: Float | None = None,
    rounds: int = NOISE_ROUNDS,
) -> Adjustment:
    """Minimise the weighted squares of residuals and priors.

    Parameters
    ----------
    layout, start
        The unknowns and their start values.
    views
        Observations of both cameras.
    nominal_nodes_mm
        (n, 3) nominal points of the target.
    priors
        Priors of the unknowns.
    max_iterations
        Limit of iterations in each round.
    noise_px
        (2,) noise to start from; from the residuals of the start without it.
    rounds
        Times that the noise is estimated again.

    Raises
    ------
    CalibrationError
        Codes ``calibration_singular``, ``calibration_not_converged``.
    """
    held = _without_tilts(layout, priors)
    fit = _adjusted(layout, start, views, nominal_nodes_mm, held, max_iterations, noise_px, rounds)
    if held is not priors:
        normal = assemble(layout, fit.state, views, nominal_nodes_mm, priors, fit.noise_px)
        _, g, _ = normal.reduced()
        gained = float(g @ covariance(normal).unknowns @ g)
        known = replace(fit.state, x=_surely_distorted(layout, fit.state.x, fit.covariance))
        left = _left_share(assemble(layout, known, views, nominal_nodes_mm, priors, fit.noise_px), held)
        if gained > _SHOWN_TILT or left < _LEFT_TILT:
            fit = _adjusted(
                layout, fit.state, views, nominal_nodes_mm, priors, max_iterations, fit.noise_px, rounds, fit.iterations
            )
    normal = assemble(layout, fit.state, views, nominal_nodes_mm, priors.opened, fit.noise_px)
    unknowns, by_prior = _with_held(layout, normal, fit.covariance, fit.by_prior)
    return replace(fit, priors=priors, covariance=unknowns, by_prior=by_prior)


def expected_covariance(
    layout: Layout, state: State, views: Sequence[ViewRows], nominal_nodes_mm: Float, priors: Priors, noise_px: Float
) -> tuple[Float, dict[Cause, Float]]:
    """Return the covariance that :func:`adjust` would state for views without any residual at a state.

    Parameters
    ----------
    layout, state, views, nominal_nodes_mm, priors
        As in :func:`adjust`.
    noise_px
        (2,) noise of the views.

    Returns
    -------
    tuple
        The covariance (m, m) of the unknowns, and its parts by the priors of stage and target. An axis' tilt is held at
        its prior by the same rule; it shows in no residual, but the views alone may determine it.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular``.
    """

    def stated(known: Priors) -> tuple[Float, dict[Cause, Float]]:
        normal = assemble(layout, state, views, nominal_nodes_mm, known, noise_px)
        found = covariance(normal)
        return found.unknowns, parts_of_priors(layout, normal, found)

    held = _without_tilts(layout, priors)
    unknowns, by_prior = stated(held)
    if held is not priors:
        surely = replace(state, x=_surely_distorted(layout, state.x, unknowns))
        if _left_share(assemble(layout, surely, views, nominal_nodes_mm, priors, noise_px), held) < _LEFT_TILT:
            unknowns, by_prior = stated(priors)
    normal = assemble(layout, state, views, nominal_nodes_mm, priors.opened, noise_px)
    return _with_held(layout, normal, unknowns, by_prior)


def _without_tilts(layout: Layout, priors: Priors) -> Priors:
    """Return priors that hold the axes' tilts at the mean; the same priors if no tilt is free."""
    tilts = [k for c in range(2) for k in range(layout.tilt(c).start, layout.tilt(c).stop)]
    if not priors.free[tilts].any():
        return priors
    free, weight = priors.free.copy(), priors.weight.copy()
    free[tilts], weight[tilts] = False, 0.0
    return replace(priors, free=free, weight=weight)


def _surely_distorted(layout: Layout, found: Float, fitted: Float) -> Float:
    """Return the unknowns (m,) with the distortion reduced by its possible error, from the covariance (m, m)."""
    x = found.copy()
    sigma = np.sqrt(np.diagonal(fitted))
    for c in range(2):
        lens = layout.lens(c)
        terms = slice(lens.start + 3, lens.stop - 1)
        x[terms] = np.sign(x[terms]) * np.maximum(np.abs(x[terms]) - _SURE * sigma[terms], 0.0)
    return x


def _left_share(normal: Normal, held: Priors) -> float:
    """Return the smallest remaining share of the prior's standard deviation for the unknowns that ``held`` holds."""
    tilts = np.flatnonzero(normal.free & ~held.free)
    root = np.sqrt(normal.prior[tilts])
    left = covariance(normal).unknowns[np.ix_(tilts, tilts)] * root[:, None] * root
    return float(np.sqrt(np.linalg.eigvalsh(left)[0]))


def _with_held(
    layout: Layout, normal: Normal, fitted: Float, by_prior: dict[Cause, Float]
) -> tuple[Float, dict[Cause, Float]]:
    """Add the effect of held unknowns with a prior to a fit's covariance (m, m) and its parts.

    ``normal`` has them free; their errors move the other unknowns, too.
    """
    held = np.flatnonzero(normal.free & (np.diagonal(fitted) == 0.0))
    if not held.size:
        return fitted, by_prior
    moved = np.zeros((len(fitted), len(held)))
    moved[held, range(len(held))] = 1.0
    moved -= fitted @ normal.reduced()[0][:, held]
    of_stage = np.isin(held, layout.stage)

    def spread(some: Bool) -> Float:
        return np.asarray((moved[:, some] / normal.prior[held[some]]) @ moved[:, some].T)

    return fitted + spread(of_stage) + spread(~of_stage), {**by_prior, "stage": by_prior["stage"] + spread(of_stage)}


def _adjusted(
    layout: Layout,
    start: State,
    views: Sequence[ViewRows],
    nominal_nodes_mm: Float,
    priors: Priors,
    max_iterations: int,
    noise_px: Float | None,
    rounds: int,
    iterations: int = 0,
) -> Adjustment:
    """Minimise over all that is free; ``iterations`` were taken before."""
    counts = np.array([float(sum(v.count for v in views if v.camera == c)) for c in range(2)])
    # the cameras' unknowns absorb more of the variance of correlated observations than of independent ones
    correlation = np.array([max([v.correlation for v in views if v.camera == c], default=1.0) for c in range(2)])
    counts -= _LENS_AND_POSE * (correlation - 1.0)

    def evaluate(state: State, noise: Float) -> Normal:
        return assemble(layout, state, views, nominal_nodes_mm, priors, noise)

    state = start
    if noise_px is None:
        noise = unfit = _noise(evaluate(state, np.ones(2)), counts - _LENS_AND_POSE)
        if priors.nodes_free:
            # the nominal target's residuals are mostly the nodes' errors; start from a localiser's noise
            noise = np.minimum(unfit, 0.01)
    else:
        noise = unfit = noise_px
    before = iterations
    for _ in range(rounds):
        try:
            state, normal, steps = _minimise(layout, state, noise, evaluate, max_iterations)
        except CalibrationError:
            if iterations > before or np.array_equal(noise, unfit):
                raise
            # views that contradict each other: far from a localiser's noise the minimum is hard to reach, and the
            # residuals there show the cause
            state, normal, steps = _minimise(layout, start, unfit, evaluate, max_iterations)
        iterations += steps
        redundancy = counts - covariance(normal).taken
        if (redundancy < 1.0).any():
            raise CalibrationError(
                f"The views leave {redundancy.min():.1f} redundant observations in one camera.",
                code="calibration_singular",
                remedy="Take more views.",
            )
        previous, noise = noise, _noise(normal, redundancy)
        if np.allclose(noise, previous, rtol=1e-3):
            break
    normal = evaluate(state, noise)
    cov = covariance(normal)
    return Adjustment(
        layout,
        state,
        priors,
        cov.unknowns,
        parts_of_priors(layout, normal, cov),
        cov.node_sigma_mm,
        noise,
        counts - cov.taken,
        normal.cost,
        iterations,
    )


def parts_of_priors(layout: Layout, normal: Normal, found: Covariance) -> dict[Cause, Float]:
    """Return the parts (m, m) of the unknowns' covariance from the priors of stage and target."""
    return {
        "stage": prior_part(normal, found, layout.stage),
        "target": prior_part(normal, found, [layout.pitch_scale], nodes=True),
    }


def _noise(normal: Normal, redundancy: Float) -> Float:
    return np.maximum(np.sqrt(normal.squares / np.maximum(redundancy, 1.0)), _MIN_NOISE_PX)


def _minimise(
    layout: Layout, state: State, noise: Float, evaluate: Callable[[State, Float], Normal], max_iterations: int
) -> tuple[State, Normal, int]:
    normal = evaluate(state, noise)
    damping = 1e-6
    recent: list[float] = []
    for iteration in range(1, max_iterations + 1):
        step, nodes = normal.step(damping)
        moved = np.zeros_like(state.nodes_mm)
        moved[:, : nodes.shape[1]] = nodes
        trial_state = state.plus(layout, step, moved)
        trial = evaluate(trial_state, noise)
        gain = normal.cost - trial.cost if trial.valid and np.isfinite(trial.cost) else -np.inf
        if gain >= 0.0:
            state, normal = trial_state, trial
            damping = max(damping * 0.1, 1e-12)
        else:
            damping *= 30.0
        # a step that changes the sum of squares by a millionth of one standard deviation is the end, and so is one
        # that cannot improve it beyond rounding
        if abs(gain) <= 1e-6 + 1e-13 * normal.cost:
            return state, normal, iteration
        if damping > 1e12:
            break
        recent = [*recent[-_LAST + 1 :], max(gain, 0.0)]
    else:
        # if the model does not fit, steps shrink slowly, and its misfit, counted as noise, is far larger than the
        # remaining gain
        if sum(recent) <= _NEAR:
            return state, normal, max_iterations
    raise CalibrationError(
        f"The adjustment did not settle in {max_iterations} iterations (sum of squares {normal.cost:.3g}).",
        code="calibration_not_converged",
        remedy="Check the rig file's nominal values and the target's description.",
    )
