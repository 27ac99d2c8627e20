"""The ``local`` model: each line a polygon about the straight model, its corners the intersections."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.grid.lines.points import LineFit, LinePoints, line_index
from stereorig.core.grid.lines.straight import Distortion
from stereorig.core.grid.view import LineOffsets


def fit_polygons(
    points: LinePoints, counts: tuple[int, int], fit: LineFit, distortion: Distortion, normal: Float, used: Bool
) -> LineFit:
    """Move the straight model's intersections across each line by a polygon through its own points' residuals."""
    na, nb = counts
    index = line_index(points, counts)
    offset = np.zeros((na, nb, 2))
    covariance_a, covariance_b = np.zeros((na, nb, nb)), np.zeros((nb, na, na))
    residual = fit.residual_px.copy()
    seen = np.ones((na, nb), dtype=bool)
    for k in range(na + nb):
        mine = index == k
        n_node = nb if k < na else na
        knot = np.clip(np.floor(points.along[mine]).astype(int), 0, n_node - 2)
        f = points.along[mine] - knot
        J = np.zeros((len(f), n_node))
        J[np.arange(len(f)), knot] = 1.0 - f
        J[np.arange(len(f)), knot + 1] = f
        W = np.where(used[mine], 1.0 / points.sigma_px[mine] ** 2, 0.0)
        N = (J * W[:, None]).T @ J
        # a corner without points on either side is not seen; a weak tie of second differences keeps the rest solvable
        beside = ((J > 0.0) & used[mine, None]).any(axis=0)
        seen[(k, slice(None)) if k < na else (slice(None), k - na)] &= beside
        S = np.diff(np.eye(n_node), 2, axis=0)
        N += 1e-6 * np.median(W) * S.T @ S
        A = np.linalg.solve(N, (J * W[:, None]).T)
        corner = A @ fit.residual_px[mine]
        # the points' noise is across the line in the image, as is the offsets' covariance: the scale of the corrected
        # coordinates changes little between a corner and the neighbouring points
        noise = (A * points.sigma_px[mine] ** 2) @ A.T
        residual[mine] = fit.residual_px[mine] - J @ corner
        if k < na:
            offset[k, :, 0], covariance_a[k] = corner, noise
        else:
            offset[:, k - na, 1], covariance_b[k - na] = corner, noise
    M = np.zeros((na, nb, 2, 2))
    M[..., 0, :] = normal[:na, None]
    M[..., 1, :] = normal[None, na:]
    move = np.linalg.solve(M, offset[..., None])[..., 0] / distortion.scale_px
    straight = fit.straight_px + move
    nodes = distortion.distort(straight)
    across = np.stack([distortion.gradient(nodes, M[..., r, :]) for r in range(2)], axis=-2)
    inverse = np.linalg.inv(across)
    V = np.zeros((na, nb, 2, 2))
    V[..., 0, 0] = np.einsum("ijj->ij", covariance_a)
    V[..., 1, 1] = np.einsum("jii->ij", covariance_b)
    offsets = LineOffsets(
        normal_a=across[..., 0, :], normal_b=across[..., 1, :], covariance_a=covariance_a, covariance_b=covariance_b
    )
    covariance = inverse @ V @ np.swapaxes(inverse, -1, -2)
    nodes[~seen] = straight[~seen] = np.nan
    return LineFit(nodes, covariance, residual, points.sigma_px**2, straight, offsets)
