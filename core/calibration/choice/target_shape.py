"""Covariance of smooth errors of the target (scale, stretch, shear and bend), in addition to single points' errors.

A print, a plate or a sheet has smooth errors: neighbouring points are displaced together, so that averaging many points
does not reduce the error. The size of such errors, and of single points' errors, is estimated from the views (all but
the scale, which no view of one target shows); if the views show none, the tolerance gives the expected size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.screening import Screened
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.fit.model import linearise_all
from stereorig.core.calibration.fit.normal import Extra, Normal, assemble, covariance

_WITHIN = 9  # scale, stretch, shear, and six bends of second degree, within the plane; three across it follow
# weight of the tolerance as a number of errors, relative to one for each error that the views show; for errors of the
# target as a whole it is multiplied by the fourth power of the share of the expected variance that the views leave
# open, so that it counts if they show little. By measurement: exact boards 1.02 to 1.21, independent points 0.96 to
# 1.21 of their error (2.3, 1.4 with squares)
_EXPECTED_POINT, _EXPECTED = 0.1, 0.5
_ROUNDS, _SETTLED = 100, 3e-3
_LEAST = 1e-6  # share of an expected variance; smaller ones count as zero


def smooth_modes(points_mm: Float) -> Float:
    """Return displacements (n, 3, 12) of points (n, 3) of a plane target, 1 at its rim: scale first, bows last."""
    x, y = (points_mm[:, :2] / np.abs(points_mm[:, :2]).max()).T
    out = np.zeros((len(points_mm), 3, _WITHIN + 3))
    out[:, 0, :3] = np.stack([x, x, y], axis=-1)
    out[:, 1, :3] = np.stack([y, -y, x], axis=-1)
    second = np.stack([x * x, x * y, y * y], axis=-1)
    second = second - second.mean(axis=0)
    for axis, first in enumerate((3, 6, _WITHIN)):
        out[:, axis, first : first + 3] = second
    return out


def with_smooth_errors(fit: Screened) -> Adjustment:
    """Return the adjustment with the target's errors, as large as the views show them, in its covariance.

    Unchanged if no point may have an error. The estimate is kept: to first order its error is the effect of the
    target's errors, whose second moments are added to the covariance.
    """
    adjustment, problem = fit.adjustment, fit.problem
    within, across = problem.node_sigma_mm
    if within <= 0.0:
        return adjustment
    layout, nodes = adjustment.layout, problem.flat_nodes_mm
    modes = smooth_modes(nodes)
    if adjustment.priors.free[layout.pitch_scale]:
        modes[..., 0] = 0.0  # the scale's uncertainty was declared and is already in the covariance
    lins = linearise_all(layout, adjustment.state, fit.rows, nodes)
    columns = np.arange(layout.size, layout.size + modes.shape[-1])
    extras = [Extra(columns, lin.by_node @ modes) for lin in lins]
    normal = assemble(
        layout,
        adjustment.state,
        fit.rows,
        nodes,
        adjustment.priors,
        adjustment.noise_px,
        extras=extras,
        n_extra=modes.shape[-1],
        lins=lins,
    )
    expected = np.repeat([within**2, across**2], [_WITHIN, len(columns) - _WITHIN])
    points, moments = _errors(normal, adjustment.state.nodes_mm[:, : normal.h.shape[1]], expected)
    if problem.staged:
        # a stage's views hardly distinguish a stretched or sheared target from other cameras: its points may be off by
        # all that the tolerance allows, although the rest of their errors is small
        points = np.maximum(points, 1.0 / normal.node_prior)
    S, _, Y = normal.reduced()
    assert Y is not None
    fitted = np.where(np.outer(normal.free, normal.free)[: layout.size, : layout.size], adjustment.covariance, 0.0)
    moved = fitted @ S[: layout.size, columns]
    by_point = fitted @ np.swapaxes(Y[..., : layout.size], 1, 2)
    weight = normal.node_prior * (points * normal.node_prior - 1.0)
    added = moved @ moments @ moved.T + np.einsum("nik,k,njk->ij", by_point, weight, by_point, optimize=True)
    by_prior = {**adjustment.by_prior, "target": adjustment.by_prior["target"] + added}
    return replace(adjustment, covariance=adjustment.covariance + added, by_prior=by_prior)


def _errors(normal: Normal, nodes_mm: Float, expected: Float) -> tuple[Float, Float]:
    """Return the variances (k,) of a point's own errors, and second moments (q, q) of the target's as a whole.

    Both together have the largest likelihood, up to the little that the tolerance counts for (``expected``, (q,)
    variances). ``nodes_mm`` (n, k) are the corrections found.
    """
    first = len(normal.g) - len(expected)
    least = _LEAST * expected
    point, variance = 1.0 / normal.node_prior, expected.copy()
    shown = np.arange(len(expected)) >= 1  # the views show no scale
    h = normal.h + normal.node_prior * nodes_mm
    moments = np.zeros((len(expected), len(expected)))
    free = normal.free | ((np.arange(len(normal.g)) >= first) & (np.concatenate([np.zeros(first), expected]) > 0.0))
    groups = [part for part in (np.arange(_WITHIN), np.arange(_WITHIN, len(expected))) if expected[part].any()]
    counts: list[float] = []
    for _ in range(_ROUNDS):
        before = np.concatenate([point, variance])
        prior = normal.prior.copy()
        prior[first:][expected > 0.0] = 1.0 / variance[expected > 0.0]
        trial = replace(normal, prior=prior, free=free, node_prior=1.0 / point, h=h - nodes_mm / point)
        found = covariance(trial)
        step, moved = trial.step(0.0)
        own = nodes_mm + moved
        determined = 1.0 - found.node_sigma_mm**2 / point
        for axes in (slice(0, 2), slice(2, None)):
            if own[:, axes].size:
                total = float(np.sum(own[:, axes] ** 2)) + _EXPECTED_POINT / normal.node_prior[axes][0]
                point[axes] = total / (float(np.sum(determined[:, axes])) + _EXPECTED_POINT)
        estimate, spread = step[first:], found.unknowns[first:, first:]
        moments = spread + np.outer(estimate, estimate)
        left = np.diagonal(spread) / np.maximum(variance, 1e-300)
        counts = counts or [_EXPECTED * float(np.mean(left[part[shown[part]]])) ** 4 for part in groups]
        for part, count in zip(groups, counts, strict=True):
            seen = part[shown[part]]
            total = float(np.sum(estimate[seen] ** 2)) + count * expected[part[0]]
            variance[part] = np.maximum(total / (float(np.sum(1.0 - left[seen])) + count), least[part])
        if np.allclose(np.concatenate([point, variance]), before, rtol=_SETTLED, atol=0.0):
            break
    return point, moments
