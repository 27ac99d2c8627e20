"""The centre of a dot's image against the image of the dot's centre.

Perspective carries a circle into an ellipse whose centre is not the image of the circle's, by an amount that grows with
the square of the dot's radius and with its tilt; a lens bends the outline further. Both follow from pose and lens.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereorig.core.arrays import Float

_SAMPLES = 64
_ROUNDS = 4


def dot_centre_offset_px(project: Callable[[Float], Float], points_mm: Float, radius_mm: float) -> Float:
    """Return the distance of the localiser's centre of each dot from the image of its true centre.

    The outline is drawn on the board, carried into the image, and an ellipse is fitted to it with all parts of the rim
    weighing alike, as the rim's pixels do in :func:`stereorig.core.boards.refine.refine_dots`.

    Parameters
    ----------
    project
        From points (..., 3) of the board, mm, to their image (..., 2), px.
    points_mm
        (..., 2) centres of the dots on the board, or (..., 3) for a board that is not flat; each dot is parallel to the
        plane Z = 0.
    radius_mm
        Radius of the dots.

    Returns
    -------
    Float
        (..., 2) px, to be taken off the places found, or added to those predicted. NaN where ``project`` gives NaN.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros(_SAMPLES)], axis=-1)
    given = np.asarray(points_mm, dtype=np.float64)
    places = given.reshape(-1, given.shape[-1])
    centres = np.zeros((len(places), 3))
    centres[:, : places.shape[1]] = places
    image = np.asarray(project(np.concatenate([centres[:, None], centres[:, None] + circle], axis=1)))
    centre, outline = image[:, 0], image[:, 1:]
    out = np.full_like(centre, np.nan)
    good = np.isfinite(image).all(axis=(1, 2))
    if good.any():
        out[good] = _ellipse_centres(outline[good]) - centre[good]
    return out.reshape(*given.shape[:-1], 2)


def _ellipse_centres(outline: Float) -> Float:
    """Fit ellipses (a, b; b, c), |M d| = 1, to closed outlines (n, m, 2) by the distances to their rims; (n, 2)."""
    around = np.roll(outline, -1, axis=1) - np.roll(outline, 1, axis=1)
    weight = np.linalg.norm(around, axis=-1)
    middle = outline.mean(axis=1)
    d = outline - middle[:, None]
    # points of an ellipse at equal angles of its circle have second moments of half its squared axes
    values, vectors = np.linalg.eigh(2.0 * np.einsum("nmi,nmj->nij", d, d) / d.shape[1])
    M = np.einsum("nij,nj,nkj->nik", vectors, values**-0.5, vectors)
    p = np.concatenate([middle, M[:, [0], [0]], M[:, [0], [1]], M[:, [1], [1]]], axis=1)
    for _ in range(_ROUNDS):
        a, b, c = p[:, 2, None], p[:, 3, None], p[:, 4, None]
        dx, dy = outline[..., 0] - p[:, 0, None], outline[..., 1] - p[:, 1, None]
        m, n = a * dx + b * dy, b * dx + c * dy
        rho = np.hypot(m, n)
        by_x, by_y = (a * m + b * n) / rho, (b * m + c * n) / rho
        steep = np.hypot(by_x, by_y)
        J = np.stack([-by_x, -by_y, m * dx / rho, (m * dy + n * dx) / rho, n * dy / rho], axis=-1) / steep[..., None]
        e = (rho - 1.0) / steep
        JW = J * weight[..., None]
        scale = 1.0 / np.sqrt(np.einsum("nmi,nmi->ni", JW, J))
        N = np.einsum("nmi,nmj->nij", JW, J) * scale[:, :, None] * scale[:, None, :]
        gradient = np.einsum("nmi,nm->ni", JW, e) * scale
        p = p - np.linalg.solve(N, gradient[..., None])[..., 0] * scale
    return p[:, :2]
