"""Both cameras, the stage axes and the target's nodes in one adjustment.

The unknowns are ten parameters and two axis tilts a camera, and two corrections a node, the same for both cameras.
Each node's corrections meet only its own observations, so they are eliminated (Schur complement) and the system to
solve stays 24 x 24. Priors enter as observations: the image centre, the axis tilt, and the nodes' tolerance, which
also fixes the freedoms that camera poses and node corrections share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import Bool, Float
from core.calibration.fit.model import N_CAMERA, Linearised, Observations, linearise
from core.calibration.inputs import CalibrationOptions, NominalCamera
from core.errors import CalibrationError
from core.names import CAMERAS

_P = 2 * N_CAMERA
_NOISE_ROUNDS = 4
_MIN_NOISE_PX = 1e-4  # no localiser is better; keeps noise-free observations and loose priors in one system


@dataclass(frozen=True)
class Adjustment:
    """Minimum of the adjustment.

    Attributes
    ----------
    parameters
        (2, 12): ten parameters and axis tilt of each camera.
    covariance
        (24, 24).
    node_corrections_mm, node_sigma_mm
        (n, 2); zero where nodes are held.
    noise_px
        (2,) estimated standard deviation per coordinate and camera.
    redundancy
        (2,) observations beyond the unknowns, per camera.
    iterations
        Steps taken.
    """

    parameters: Float
    covariance: Float
    node_corrections_mm: Float
    node_sigma_mm: Float
    noise_px: Float
    redundancy: Float
    iterations: int


@dataclass(frozen=True)
class _Normal:
    """Normal equations in blocks: parameters, their coupling to the nodes, nodes."""

    U: Float  # (2, 12, 12) without priors
    g: Float  # (24,) with priors
    W: Float  # (n, 24, 2)
    V: Float  # (2, n, 2, 2) without priors
    h: Float  # (n, 2) with priors
    cost: float
    weighted_squares: Float  # (2,) of the residuals in px^2
    valid: bool


def prior_terms(nominals: Sequence[NominalCamera], options: CalibrationOptions) -> tuple[Float, Float]:
    """Return prior means and weights (1/sigma^2), (24,) each; weight 0 without a prior."""
    mean, weight = np.zeros((2, N_CAMERA)), np.zeros((2, N_CAMERA))
    for c, nominal in enumerate(nominals):
        mean[c, 1:3] = nominal.centre_px
        weight[c, 1:3] = options.centre_sigma_px**-2
        if options.axis_tilt_sigma_rad > 0.0:
            weight[c, 10:] = options.axis_tilt_sigma_rad**-2
    return mean.ravel(), weight.ravel()


def free_mask(options: CalibrationOptions) -> Bool:
    """Return (24,) True for the parameters that are unknowns."""
    free = np.ones((2, N_CAMERA), dtype=bool)
    free[:, 10:] = options.axis_tilt_sigma_rad > 0.0
    return free.ravel()


def covariance_of(
    parameters: Float,
    nodes_mm: Float,
    observations: Sequence[Observations],
    nominals: Sequence[NominalCamera],
    options: CalibrationOptions,
    *,
    noise_px: Float,
    node_sigma_mm: float,
) -> Float:
    """Return the (24, 24) covariance at given parameters, without any residual: the prediction before measuring.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular``.
    """
    lins = [linearise(parameters[c], nominals[c].aspect, nodes_mm, observations[c]) for c in range(2)]
    mean, weight = prior_terms(nominals, options)
    tau = node_sigma_mm**-2 if node_sigma_mm > 0.0 else np.inf
    normal = _assemble(lins, observations, parameters.ravel(), np.zeros_like(nodes_mm), noise_px, mean, weight, tau)
    return _covariance(normal, weight, tau, free_mask(options))[0]


def adjust(
    parameters: Float,
    nodes_mm: Float,
    observations: Sequence[Observations],
    nominals: Sequence[NominalCamera],
    options: CalibrationOptions,
    *,
    node_sigma_mm: float,
) -> Adjustment:
    """Minimise the weighted squares of residuals and priors by Levenberg-Marquardt.

    Parameters
    ----------
    parameters
        (2, 12) start, from :func:`core.calibration.fit.single.fit_single`.
    nodes_mm
        (n, 2) nominal nodes.
    observations, nominals
        One each per camera.
    options
        Priors and limits.
    node_sigma_mm
        Prior on a node's corrections per axis; 0 holds the nodes.

    Raises
    ------
    CalibrationError
        Codes ``calibration_singular``, ``calibration_not_converged``.
    """
    mean, prior = prior_terms(nominals, options)
    tau = node_sigma_mm**-2 if node_sigma_mm > 0.0 else np.inf
    free = free_mask(options)
    x, d = np.array(parameters, dtype=np.float64).ravel(), np.zeros_like(nodes_mm)

    def evaluate(x_: Float, d_: Float, noise_: Float) -> _Normal:
        p = x_.reshape(2, N_CAMERA)
        lins = [linearise(p[c], nominals[c].aspect, nodes_mm + d_, observations[c]) for c in range(2)]
        return _assemble(lins, observations, x_, d_, noise_, mean, prior, tau)

    noise = np.ones(2)
    # the ten parameters absorb more of the variance of correlated observations than of independent ones
    lost = 10.0 * (np.array([o.correlation for o in observations]) - 1.0)
    counts = np.array([o.count for o in observations], dtype=np.float64) - lost
    noise = _noise(evaluate(x, d, noise), counts - 10.0)
    if node_sigma_mm > 0.0:
        # the nominal grid's residuals are mostly the nodes' errors; start from a localiser's noise
        noise = np.minimum(noise, 0.01)
    iterations = 0
    for _ in range(_NOISE_ROUNDS):
        x, d, normal, steps = _minimise(x, d, noise, evaluate, prior, tau, free, options.max_iterations)
        iterations += steps
        covariance, node_covariance, taken = _covariance(normal, prior, tau, free)
        redundancy = counts - taken
        if (redundancy < 1.0).any():
            raise CalibrationError(
                f"The views leave {redundancy.min():.1f} redundant observations in one camera.",
                code="calibration_singular",
            )
        previous, noise = noise, _noise(normal, redundancy)
        if np.allclose(noise, previous, rtol=1e-3):
            break
    normal = evaluate(x, d, noise)
    covariance, node_covariance, taken = _covariance(normal, prior, tau, free)
    redundancy = counts - taken
    node_sigma = np.sqrt(np.diagonal(node_covariance, axis1=1, axis2=2))
    return Adjustment(x.reshape(2, N_CAMERA), covariance, d, node_sigma, noise, redundancy, iterations)


def _noise(normal: _Normal, redundancy: Float) -> Float:
    return np.maximum(np.sqrt(normal.weighted_squares / np.maximum(redundancy, 1.0)), _MIN_NOISE_PX)


def _assemble(
    lins: Sequence[Linearised],
    observations: Sequence[Observations],
    x: Float,
    d: Float,
    noise_px: Float,
    mean: Float,
    prior: Float,
    tau: float,
) -> _Normal:
    n = len(d)
    U, g = np.zeros((2, N_CAMERA, N_CAMERA)), prior * (mean - x)
    W, V, h = np.zeros((n, _P, 2)), np.zeros((2, n, 2, 2)), np.zeros((n, 2))
    squares = np.zeros(2)
    for c in range(len(CAMERAS)):
        lin, w = lins[c], observations[c].weight / (noise_px[c] ** 2 * observations[c].correlation)
        span = slice(c * N_CAMERA, (c + 1) * N_CAMERA)
        weighted = lin.by_camera * w[..., None, None]
        U[c] = np.einsum("vnip,vniq->pq", weighted, lin.by_camera, optimize=True)
        g[span] += np.einsum("vnip,vni->p", weighted, lin.residual_px, optimize=True)
        W[:, span] = np.einsum("vnip,vnij->npj", weighted, lin.by_node, optimize=True)
        V[c] = np.einsum("vn,vnij,vnik->njk", w, lin.by_node, lin.by_node, optimize=True)
        h += np.einsum("vn,vnij,vni->nj", w, lin.by_node, lin.residual_px, optimize=True)
        squares[c] = np.sum(observations[c].weight[..., None] * lin.residual_px**2)
    correlation = np.array([o.correlation for o in observations])
    cost = float(np.sum(squares / (noise_px**2 * correlation)) + np.sum(prior * (mean - x) ** 2))
    if np.isfinite(tau):
        h -= tau * d
        cost += float(tau * np.sum(d**2))
    return _Normal(U, g, W, V, h, cost, squares, all(lin.valid for lin in lins))


def _with_priors(normal: _Normal, prior: Float) -> Float:
    U = np.diag(prior)
    for c in range(2):
        span = slice(c * N_CAMERA, (c + 1) * N_CAMERA)
        U[span, span] += normal.U[c]
    return U


def _solve(normal: _Normal, prior: Float, tau: float, free: Bool, damping: float) -> tuple[Float, Float]:
    U, g = _with_priors(normal, prior), normal.g.copy()
    U[np.diag_indices(_P)] *= 1.0 + damping
    Y = None
    if np.isfinite(tau):
        V = normal.V.sum(axis=0) + tau * np.eye(2)
        V[:, [0, 1], [0, 1]] *= 1.0 + damping
        Y = np.linalg.solve(V, np.swapaxes(normal.W, 1, 2))  # V^-1 W', (n, 2, 24)
        U -= np.einsum("npj,njq->pq", normal.W, Y)
        g -= np.einsum("njp,nj->p", Y, normal.h)
    step = np.zeros(_P)
    step[free] = _inverse(U[np.ix_(free, free)]) @ g[free]
    if Y is None:
        return step, np.zeros_like(normal.h)
    return step, np.linalg.solve(V, normal.h[..., None])[..., 0] - Y @ step


def _inverse(matrix: Float) -> Float:
    """Invert a symmetric positive definite matrix after scaling its diagonal to one."""
    diagonal = np.diagonal(matrix)
    if not np.isfinite(matrix).all() or (diagonal <= 0.0).any():
        raise CalibrationError("The normal equations hold no finite positive diagonal.", code="calibration_singular")
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
    if values[0] <= 1e-14 * values[-1]:
        raise CalibrationError(
            f"The views do not determine the cameras: the normal equations' eigenvalues go from {values[0]:.1e} to "
            f"{values[-1]:.1e}.",
            code="calibration_singular",
            remedy="Take views at stage positions that lie further apart.",
        )
    half = (vectors / np.sqrt(values)) * scale[:, None]
    return np.asarray(half @ half.T)


def _minimise(
    x: Float,
    d: Float,
    noise: Float,
    evaluate: Callable[[Float, Float, Float], _Normal],
    prior: Float,
    tau: float,
    free: Bool,
    max_iterations: int,
) -> tuple[Float, Float, _Normal, int]:
    normal = evaluate(x, d, noise)
    damping = 1e-6
    for iteration in range(1, max_iterations + 1):
        dx, dd = _solve(normal, prior, tau, free, damping)
        trial = evaluate(x + dx, d + dd, noise)
        gain = normal.cost - trial.cost if trial.valid and np.isfinite(trial.cost) else -np.inf
        if gain >= 0.0:
            x, d, normal = x + dx, d + dd, trial
            damping = max(damping * 0.1, 1e-12)
        else:
            damping *= 30.0
        # a step that changes the sum of squares by a millionth of one standard deviation is the end, and so is one
        # that cannot improve it beyond rounding
        if abs(gain) <= 1e-6 + 1e-13 * normal.cost:
            return x, d, normal, iteration
        if damping > 1e12:
            break
    raise CalibrationError(
        f"The adjustment did not settle in {max_iterations} iterations (sum of squares {normal.cost:.3g}).",
        code="calibration_not_converged",
    )


def _covariance(normal: _Normal, prior: Float, tau: float, free: Bool) -> tuple[Float, Float, Float]:
    """Covariance of the parameters (24, 24) and of each node (n, 2, 2); observations taken up, per camera (2,)."""
    S = _with_priors(normal, prior)
    n = len(normal.h)
    C = np.zeros((_P, _P))
    if np.isfinite(tau):
        V_inv = np.linalg.inv(normal.V.sum(axis=0) + tau * np.eye(2))
        Y = V_inv @ np.swapaxes(normal.W, 1, 2)
        S -= np.einsum("npj,njq->pq", normal.W, Y)
        C[np.ix_(free, free)] = _inverse(S[np.ix_(free, free)])
        CY = C @ np.swapaxes(Y, 1, 2)  # minus the covariance of parameters and nodes, (n, 24, 2)
        C_nn = V_inv + Y @ CY
    else:
        C[np.ix_(free, free)] = _inverse(S[np.ix_(free, free)])
        CY, C_nn = np.zeros((n, _P, 2)), np.zeros((n, 2, 2))
    taken = np.zeros(2)
    for c in range(2):
        span = slice(c * N_CAMERA, (c + 1) * N_CAMERA)
        taken[c] = np.sum(C[span, span] * normal.U[c])
        taken[c] -= 2.0 * np.sum(CY[:, span] * normal.W[:, span])
        taken[c] += np.sum(C_nn * normal.V[c])
    return C, C_nn, taken
