"""Start values of the matching at a point, and their transfer to another point.

The unknowns are the matching's: inverse depth and its slopes ``w = (w0, w1, w2)`` over camera 1's normalised ray
offsets (X, Y) from the point's own ray, and the 3 x 3 matrix ``G`` that maps the patch to its current position. The
point on the patch at offset (X, Y) is at ``(Xc + X, Yc + Y, 1) / w(X, Y)`` in the reference and at ``G (1, X, Y) / w(X,
Y)`` currently, both in camera 1's frame. Both are linear for a plane patch, so a patch's own unknowns give a
neighbour's on the same plane exactly. A curved patch also has the terms X^2, X Y and Y^2: ``w`` has 6 numbers, ``G`` 3
x 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair


@dataclass(frozen=True, eq=False)
class Starts:
    """Unknowns at n points (leading axes free).

    Attributes
    ----------
    w
        (..., 3) inverse depth 1/mm, and slopes; (..., 6) with a curved patch's second-order terms.
    G
        (..., 3, 3) or (..., 3, 6), or None for a shape.
    """

    w: Float
    G: Float | None = None


def move_w(w: Float, offset: Float) -> Float:
    """Return ``w`` (n, 3 or 6) about points ``offset`` (n, 2) further on in normalised coordinates."""
    return move_matrix(w[:, None, :], offset)[:, 0]


def move_matrix(G: Float, offset: Float) -> Float:
    """Return ``G`` (n, 3, 3 or 6) about points ``offset`` (n, 2) further on."""
    x, y = offset[:, :1], offset[:, 1:]
    moved = G.copy()
    moved[:, :, 0] += G[:, :, 1] * x + G[:, :, 2] * y
    if G.shape[2] == 6:
        xx, xy, yy = G[:, :, 3], G[:, :, 4], G[:, :, 5]
        moved[:, :, 0] += xx * x**2 + xy * x * y + yy * y**2
        moved[:, :, 1] += 2.0 * xx * x + xy * y
        moved[:, :, 2] += xy * x + 2.0 * yy * y
    return moved


def current_position(w: Float, G: Float) -> Float:
    """Return the points' current positions, (n, 3) mm in camera 1's frame."""
    return np.asarray(G[..., :, 0] / w[..., :1])


def image_positions(pair: StereoPair, w: Float, column: Float) -> tuple[Float, Float]:
    """Return the images (n, 2) px of points in both cameras, given ``w`` (n, ...) and a column (n, 3) of ``G``.

    With the first column of ``G`` the current images; with the points' rays the reference's images.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        one = column[:, :2] / column[:, 2:]
        point = pair.cam2_from_cam1.apply(column / w[:, :1])
        two = point[:, :2] / point[:, 2:]
    return pair.cam1.lens.image_from_normalised(one).xy, pair.cam2.lens.image_from_normalised(two).xy


def image_shift_px(pair: StereoPair, rays: Float, w_a: Float, w_b: Float) -> Float:
    """Return the shift (n,) of camera 2's image, px, when the inverse depth on camera 1's rays changes from a to b."""
    pose = pair.cam2_from_cam1
    with np.errstate(divide="ignore", invalid="ignore"):
        images = [
            pair.cam2.lens.image_from_normalised(p[..., :2] / p[..., 2:]).xy
            for p in (pose.apply(rays / w[..., None]) for w in (w_a, w_b))
        ]
    return np.asarray(np.linalg.norm(images[0] - images[1], axis=-1))


def view_cosines(pair: StereoPair, rays: Float, w: Float) -> tuple[Float, Float]:
    """Return (n,), (n,) the cosines between the patch's normal and the rays to camera 1 and camera 2.

    The plane w0 + w1 X + w2 Y = 1/Z has the camera-1 normal (w1, w2, w0 - w1 Xc - w2 Yc).
    """
    normal = np.stack([w[:, 1], w[:, 2], w[:, 0] - w[:, 1] * rays[:, 0] - w[:, 2] * rays[:, 1]], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        point = rays / w[:, :1]
        centre2 = pair.cam2_from_cam1.inverse().translation_mm
        view1 = point / np.linalg.norm(point, axis=-1, keepdims=True)
        view2 = (point - centre2) / np.linalg.norm(point - centre2, axis=-1, keepdims=True)
        return np.sum(normal * view1, axis=-1), np.sum(normal * view2, axis=-1)
