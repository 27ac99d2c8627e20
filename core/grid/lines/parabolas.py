"""The ``parabola`` model: each line by itself a parabola across its own direction."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.grid.lines.points import LineFit, LinePoints, frames, line_index, meet_straight


def fit_parabolas(points: LinePoints, counts: tuple[int, int], node_sigma_px: float, used: Bool) -> LineFit:
    """Fit a parabola to each line by itself, and meet them; see :func:`stereorig.core.grid.lines.fit_lines`."""
    index = line_index(points, counts)
    n_line = sum(counts)
    origin, direction, normal = frames(points, points.xy_px, counts)
    variance = points.sigma_px**2 + node_sigma_px**2
    bend = np.zeros((n_line, 3))
    cov = np.zeros((n_line, 3, 3))
    residual = np.empty(len(index))
    for k in range(n_line):
        mine = index == k
        d = points.xy_px[mine] - origin[k]
        t, y = d @ direction[k], d @ normal[k]
        J = np.stack([np.ones_like(t), t, t * t], axis=-1)
        W = np.where(used[mine], 1.0 / variance[mine], 0.0)
        if np.count_nonzero(W) < 4:
            raise np.linalg.LinAlgError(f"line {k} has {np.count_nonzero(W)} points")
        A = np.linalg.solve((J * W[:, None]).T @ J, (J * W[:, None]).T)
        bend[k] = A @ y
        cov[k] = (A * points.sigma_px[mine] ** 2) @ A.T
        residual[mine] = y - J @ bend[k]
    nodes, node_cov = meet_parabolas(origin, direction, bend, cov, counts)
    return LineFit(nodes, node_cov, residual, variance, nodes)


def meet_parabolas(
    origin: Float, direction: Float, bend: Float, covariance: Float, counts: tuple[int, int]
) -> tuple[Float, Float]:
    """Meet lines that are parabolas across their own directions.

    Parameters
    ----------
    origin, direction
        (n, 2) of each line, family a first.
    bend, covariance
        (n, 3) offset along the normal (-dy, dx), lowest power first, and (n, 3, 3).
    counts
        (n_a, n_b).

    Returns
    -------
    nodes, covariance
        (n_a, n_b, 2) and (n_a, n_b, 2, 2).
    """
    na, nb = counts
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    oa, da, ma, ba = (v[:na, None] for v in (origin, direction, normal, bend))
    ob, db, mb, bb = (v[None, na:] for v in (origin, direction, normal, bend))
    x = meet_straight(origin + bend[:, :1] * normal, direction + bend[:, 1:2] * normal, counts)
    ga = gb = np.zeros((na, nb, 2))
    for _ in range(6):
        ta, tb = np.sum((x - oa) * da, axis=-1), np.sum((x - ob) * db, axis=-1)
        fa = np.sum((x - oa) * ma, axis=-1) - (ba[..., 0] + ta * (ba[..., 1] + ta * ba[..., 2]))
        fb = np.sum((x - ob) * mb, axis=-1) - (bb[..., 0] + tb * (bb[..., 1] + tb * bb[..., 2]))
        ga = ma - (ba[..., 1] + 2.0 * ta * ba[..., 2])[..., None] * da
        gb = mb - (bb[..., 1] + 2.0 * tb * bb[..., 2])[..., None] * db
        x = x - np.linalg.solve(np.stack([ga, gb], axis=-2), np.stack([fa, fb], axis=-1)[..., None])[..., 0]
    ta, tb = np.sum((x - oa) * da, axis=-1), np.sum((x - ob) * db, axis=-1)
    pa, pb = (np.stack([np.ones_like(t), t, t * t], axis=-1) for t in (ta, tb))
    va = np.einsum("ijk,ikl,ijl->ij", pa, covariance[:na], pa)
    vb = np.einsum("ijk,jkl,ijl->ij", pb, covariance[na:], pb)
    inverse = np.linalg.inv(np.stack([ga, gb], axis=-2))
    across = np.zeros((na, nb, 2, 2))
    across[..., 0, 0], across[..., 1, 1] = va, vb
    return x, inverse @ across @ np.swapaxes(inverse, -1, -2)
