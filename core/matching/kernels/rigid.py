"""The paper's rigid patch: its nine unknowns as a constraint on the stretch patch's twelve."""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.matching.kernels.naming import inner

N_RIGID = 10


@inner
def _frame(tangents, frame):
    """Orthonormal frame (columns) on two tangent vectors (rows): along their bisectors, so neither is preferred."""
    a, b = tangents[0], tangents[1]
    la = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    lb = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    ls = 0.0
    ld = 0.0
    for i in range(3):
        s, d = a[i] / la + b[i] / lb, a[i] / la - b[i] / lb
        frame[i, 0], frame[i, 1] = s, d
        ls += s * s
        ld += d * d
    if not (ls > 0.0 and ld > 0.0):
        return False
    for i in range(3):
        frame[i, 0] /= math.sqrt(ls)
        frame[i, 1] /= math.sqrt(ld)
    frame[0, 2] = frame[1, 0] * frame[2, 1] - frame[2, 0] * frame[1, 1]
    frame[1, 2] = frame[2, 0] * frame[0, 1] - frame[0, 0] * frame[2, 1]
    frame[2, 2] = frame[0, 0] * frame[1, 1] - frame[1, 0] * frame[0, 1]
    return np.isfinite(ls + ld)


@inner
def nearest_rotation(xc, yc, w, G, rotation, work):
    """Rotation that carries the reference patch's tangents closest to those in ``G``; ``work`` has 8 rows of 3."""
    before, after, tangents = work[:3], work[3:6], work[6:8]
    for j in range(2):
        r = w[1 + j] / w[0]
        tangents[j, 0], tangents[j, 1], tangents[j, 2] = -xc * r, -yc * r, -r
        tangents[j, j] += 1.0
    if not _frame(tangents, before):
        return False
    for j in range(2):
        for i in range(3):
            tangents[j, i] = G[i, 1 + j] - G[i, 0] * w[1 + j] / w[0]
    if not _frame(tangents, after):
        return False
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += after[i, k] * before[j, k]
            rotation[i, j] = s
    return True


@inner
def rotate(rotation, a, b, c):
    """Replace ``rotation`` by exp([(a, b, c)]x) ``rotation``, exactly (Rodrigues)."""
    angle = math.sqrt(a * a + b * b + c * c)
    if angle < 1e-6:  # series, so that no small angle divides by itself
        s, v = 1.0 - angle * angle / 6.0, 0.5
    else:
        s, v = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        c1x, c1y, c1z = b * z - c * y, c * x - a * z, a * y - b * x
        c2x, c2y, c2z = b * c1z - c * c1y, c * c1x - a * c1z, a * c1y - b * c1x
        rotation[0, j] = x + s * c1x + v * c2x
        rotation[1, j] = y + s * c1y + v * c2y
        rotation[2, j] = z + s * c1z + v * c2z


@inner
def rigid_columns(xc, yc, w, rotation, G):
    """Fill G's second and third column from w, the first column and the rotation."""
    for j in range(2):
        r = w[1 + j] / w[0]
        for i in range(3):
            turned = rotation[i, 0] * xc + rotation[i, 1] * yc + rotation[i, 2]
            G[i, 1 + j] = rotation[i, j] + r * (G[i, 0] - turned)


@inner
def rigid_chain(xc, yc, w, rotation, G, chain):
    """Compute d(thirteen unknowns) / d(w1, w2, rotation vector, w0, G0, e), (13, 10), at the present state."""
    for i in range(13):
        for j in range(N_RIGID):
            chain[i, j] = 0.0
    for i in range(4):
        chain[8 + i, 5 + i] = 1.0
    chain[0, 0] = 1.0
    chain[4, 1] = 1.0
    chain[12, 9] = 1.0
    for j in range(2):
        r = w[1 + j] / w[0]
        first = 1 + 4 * j
        for i in range(3):
            turned = rotation[i, 0] * xc + rotation[i, 1] * yc + rotation[i, 2]
            chain[first + i, 5] = -r / w[0] * (G[i, 0] - turned)
            chain[first + i, 6 + i] = r
            chain[first + i, j] = (G[i, 0] - turned) / w[0]
        # rotated tangent a: d(exp(o) a) / do = -[a]x
        a0 = rotation[0, j] - r * (rotation[0, 0] * xc + rotation[0, 1] * yc + rotation[0, 2])
        a1 = rotation[1, j] - r * (rotation[1, 0] * xc + rotation[1, 1] * yc + rotation[1, 2])
        a2 = rotation[2, j] - r * (rotation[2, 0] * xc + rotation[2, 1] * yc + rotation[2, 2])
        chain[first, 3], chain[first, 4] = a2, -a1
        chain[first + 1, 2], chain[first + 1, 4] = -a2, a0
        chain[first + 2, 2], chain[first + 2, 3] = a1, -a0
