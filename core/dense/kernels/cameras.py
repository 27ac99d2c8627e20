"""The exact cameras at one vector: from its unknowns to pixels, and from increments in pixels to its unknowns."""

from __future__ import annotations

from stereorig.core.matching.kernels.naming import inner
from stereorig.core.matching.kernels.warp import image_of


@inner
def positions(lens1, lens2, R, t, ray, state, shift, images, out, slopes):
    """Image positions of a point, and their derivatives.

    Parameters
    ----------
    lens1, lens2, R, t
        The cameras; R and t map camera 1's frame into camera 2's.
    ray
        (2,) x and y of the point's ray in camera 1.
    state
        (5,) inverse depth, current position over depth, offset across the epipolar line.
    shift
        (2,) camera 2's normalised shift for an offset of one.
    images
        1 (camera 2's reference), or 3 (also camera 1's and camera 2's current image).
    out
        (6,) out, px.
    slopes
        (6, 5) out.
    """
    for i in range(6):
        for j in range(5):
            slopes[i, j] = 0.0
    w, e = state[0], state[4]
    for k in range(images):
        a, b, c = ray[0], ray[1], 1.0
        if k > 0:
            a, b, c = state[1], state[2], state[3]
        if k == 1:
            x, y, j11, j12, j21, j22 = image_of(lens1, a / c, b / c)
            out[2], out[3] = x, y
            for i in range(3):
                du = (1.0 if i == 0 else 0.0) / c - (a / (c * c) if i == 2 else 0.0)
                dv = (1.0 if i == 1 else 0.0) / c - (b / (c * c) if i == 2 else 0.0)
                slopes[2, 1 + i] = j11 * du + j12 * dv
                slopes[3, 1 + i] = j21 * du + j22 * dv
            continue
        q0 = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0] * w
        q1 = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1] * w
        q2 = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2] * w
        u, v = q0 / q2, q1 / q2
        x, y, j11, j12, j21, j22 = image_of(lens2, u + e * shift[0], v + e * shift[1])
        out[2 * k], out[2 * k + 1] = x, y
        for i in range(4):
            if i == 0:
                d0, d1, d2 = t[0], t[1], t[2]
            elif k == 0:
                continue
            else:
                d0, d1, d2 = R[0, i - 1], R[1, i - 1], R[2, i - 1]
            du, dv = (d0 - u * d2) / q2, (d1 - v * d2) / q2
            slopes[2 * k, i] = j11 * du + j12 * dv
            slopes[2 * k + 1, i] = j21 * du + j22 * dv
        slopes[2 * k, 4] = j11 * shift[0] + j12 * shift[1]
        slopes[2 * k + 1, 4] = j21 * shift[0] + j22 * shift[1]
    return


@inner
def factor(a, n):
    """Cholesky's lower factor in place; False if not positive."""
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if not s > 1e-300:
                    return False
                a[i, i] = s**0.5
            else:
                a[i, j] = s / a[j, j]
    return True


@inner
def invert_lower(a, n, out):
    """Inverse of a lower factor, into the lower part of ``out``."""
    for j in range(n):
        out[j, j] = 1.0 / a[j, j]
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s -= a[i, k] * out[k, j]
            out[i, j] = s / a[i, i]
