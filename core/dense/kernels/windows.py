"""The vectors of a band of rows: warp once, sum once, one Gauss-Newton step each.

Row by row of pixels, each image is interpolated at the predicted places, and the products that the normal equations
need are added to the sums of columns, which run down the image over a window's height. Along a row of vectors these
sums run over a window's width. All sums are in double precision.

A vector's increment is a shift: the prediction's slopes and curvature are kept. Increments with slopes of their own
have the same bias, and more noise (docs/explanation/decisions/0041-dense-field.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from stereorig.core.dense.kernels import rows as q
from stereorig.core.dense.kernels.cameras import factor, invert_lower, positions
from stereorig.core.dense.kernels.given import DenseSpace
from stereorig.core.dense.kernels.rows import N_ROWS, add_row, columns_of
from stereorig.core.matching.kernels.lattice import cubic, interpolate_cubic, interpolate_quintic, places
from stereorig.core.matching.kernels.naming import inner, kernel
from stereorig.core.matching.kernels.noise import CONTRAST, DENSITY, N_LEVELS, joint_weights
from stereorig.core.matching.kernels.point import LOW_TEXTURE, OK, OUTSIDE_IMAGE, SINGULAR
from stereorig.core.matching.kernels.vectors import LANES
from stereorig.core.matching.kernels.warp import undistort
from stereorig.core.status import PointStatus

MASKED = int(PointStatus.MASKED)
_MIN_CONTRAST2 = 1e-6


class DenseKernels(NamedTuple):
    """The kernel of a band and the maker of its work space."""

    band: Any
    space: Callable[[int, int, int, int], DenseSpace]


@inner
def _row_of_pixels(y, reference, blocked, images, lattice, nodes, seen, grey, order, n_images, row, space):
    """Fill one row of pixels: the weights, the reference, and the images at the predicted places."""
    pixels, grad_x, grad_y, weights = reference
    lines, tap, tx, ty = space
    cols = pixels.shape[1]
    top = math.floor((y - lattice.y0) / lattice.spacing + lattice.rim)
    if y >= pixels.shape[0] or top < 0 or top >= seen.shape[0]:
        for r in range(row.shape[0]):
            for x in range(cols):
                row[r, x] = 0.0
        return
    for x in range(cols):
        row[0, x] = 1.0
    lead = 1 if order == 3 else 2
    blocks = np.int64((cols + LANES - 1) // LANES)
    for k in range(n_images):
        places(y, lattice, nodes, seen, images[k], (k, cols), lead, lines, row, tap, tx, ty)
        coefficients, stride, grey_row = images[k].coefficients, np.int64(images[k].stride), row[N_ROWS + k]
        if order == 3:
            interpolate_cubic(coefficients, stride, tap, tx, ty, blocks, grey_row)
        else:
            interpolate_quintic(coefficients, stride, tap, tx, ty, blocks, grey_row)
        level = np.float32(grey[1 + k])
        for x in range(cols):
            grey_row[x] -= level
    if blocked.shape[0] > 0:
        for x in range(cols):
            if blocked[y, x] != 0:
                row[0, x] = 0.0
    level, weighted = np.float32(grey[0]), weights.shape[0] > 0
    for x in range(cols):
        one = np.float32(1.0) if row[0, x] == 1.0 else np.float32(0.0)
        if weighted:
            one *= weights[y, x]
        row[1, x] = one
        row[2, x] = pixels[y, x] - level
        row[3, x] = one * grad_x[y, x]
        row[4, x] = one * grad_y[y, x]
        row[5, x] = np.float32(1.0) / one if one > 0.0 else np.float32(0.0)


@inner
def _slide(column, first, wide, step, n, out):
    """Sums ``out`` (n,) of ``wide`` neighbours, the first of them at ``first``, then ``step`` further on each time."""
    s = 0.0
    for x in range(first, first + wide):
        s += column[x]
    out[0] = s
    for i in range(1, n):
        at = first + (i - 1) * step
        change = 0.0
        for j in range(step):
            change += column[at + wide + j] - column[at + j]
        s += change
        out[i] = s


def make_windows(images: int) -> DenseKernels:
    """Compile the kernel for a shape (1 image compared) or a motion (3)."""
    n_columns = columns_of(images)
    add = add_row[images]

    def space(width: int, subset: int, cells: int, vectors: int) -> DenseSpace:
        wide = (width + LANES - 1) // LANES * LANES
        return DenseSpace(
            ring=np.zeros((subset, N_ROWS + images, wide), np.float32),
            lines=np.zeros((4, cells + 1)),
            tap=np.zeros(wide, np.int32),
            tx=np.zeros(wide, np.float32),
            ty=np.zeros(wide, np.float32),
            sums=np.zeros((n_columns, wide)),
            windows=np.zeros((n_columns, vectors)),
            levels=np.zeros((images, N_LEVELS)),
            weights=np.zeros((images, images)),
            normal=np.zeros((2, 5, 5)),
            small=np.zeros((26, 6)),
            local=np.zeros(8),
        )

    @kernel(f"{images}")
    def vector(s, i, at, per_px, given, nodes, state, parts, out, r, c):
        """One vector; status."""
        lens1, lens2, R, t, to_sys, variances = given
        levels, weights, normal, small = parts
        x_px, y_px, cell_r, cell_c, u, v = at
        values, covariance, epipolar, zncc, misfit, moved, sigma, _ = out
        p = s[q.P, i]
        f2 = s[q.FF, i] - s[q.F, i] * s[q.F, i] / p
        if not f2 > 1e-3 * p:
            return LOW_TEXTURE
        level = s[q.F, i] / p
        sum_gx, sum_gy = s[q.GX, i], s[q.GY, i]
        sum_fgx, sum_fgy = s[q.FGX, i] - level * sum_gx, s[q.FGY, i] - level * sum_gy
        # gain and offset taken out
        xx = s[q.GXX, i] - sum_gx * sum_gx / p - sum_fgx * sum_fgx / f2
        xy = s[q.GXY, i] - sum_gx * sum_gy / p - sum_fgx * sum_fgy / f2
        yy = s[q.GYY, i] - sum_gy * sum_gy / p - sum_fgy * sum_fgy / f2
        det = xx * yy - xy * xy
        if not (det > 1e-9 * (xx + yy) * (xx + yy) and xx > 0.0):
            return LOW_TEXTURE
        c00, c01, c11 = yy / det, -xy / det, xx / det
        measured, predicted, turn = small[0], small[1], small[2]
        for k in range(images):
            base = q.FIRST + q.EACH * k
            mean = s[base + q.G, i] / p
            g2 = s[base + q.GG, i] - mean * s[base + q.G, i]
            if not g2 > _MIN_CONTRAST2 * f2:
                return LOW_TEXTURE
            contrast = math.sqrt(g2 / f2)
            per_contrast = 1.0 / contrast
            correlation = (s[base + q.FG, i] - mean * s[q.F, i]) * per_contrast / f2
            levels[k, CONTRAST] = contrast
            bx = (s[base + q.GGX, i] - mean * sum_gx) * per_contrast - sum_fgx
            by = (s[base + q.GGY, i] - mean * sum_gy) * per_contrast - sum_fgy
            sx, sy = -(c00 * bx + c01 * by), -(c01 * bx + c11 * by)
            left = 2.0 * f2 * (1.0 - correlation) + sx * bx + sy * by
            left = max(left, 0.0)
            zncc[r, c, k] = 1.0 - 0.5 * left / f2
            misfit[r, c, k] = left / p
            # the prediction's own place and slopes at the vector
            for j in range(2):
                corner = small[3]
                for m in range(2):
                    top, low = nodes[cell_r, cell_c + m, 2 * k + j], nodes[cell_r + 1, cell_c + m, 2 * k + j]
                    corner[m] = cubic(top[0], top[2], low[0], low[2], v)
                    corner[2 + m] = cubic(top[1], top[3], low[1], low[3], v)
                    d = low[0] - top[0]
                    small[4, m] = (
                        top[2]
                        + v * (6.0 * d - 4.0 * top[2] - 2.0 * low[2])
                        + v * v * (3.0 * (top[2] + low[2]) - 6.0 * d)
                    )
                    d = low[1] - top[1]
                    small[4, 2 + m] = (
                        top[3]
                        + v * (6.0 * d - 4.0 * top[3] - 2.0 * low[3])
                        + v * v * (3.0 * (top[3] + low[3]) - 6.0 * d)
                    )
                d = corner[1] - corner[0]
                predicted[j] = cubic(corner[0], corner[2], corner[1], corner[3], u)
                turn[2 * j] = (
                    corner[2]
                    + u * (6.0 * d - 4.0 * corner[2] - 2.0 * corner[3])
                    + u * u * (3.0 * (corner[2] + corner[3]) - 6.0 * d)
                )
                turn[2 * j + 1] = cubic(small[4, 0], small[4, 2], small[4, 1], small[4, 3], u)
            for j in range(4):
                turn[j] *= per_px
            measured[2 * k] = predicted[0] + turn[0] * sx + turn[1] * sy
            measured[2 * k + 1] = predicted[1] + turn[2] * sx + turn[3] * sy
            det = turn[0] * turn[3] - turn[1] * turn[2]
            if not abs(det) > 1e-6:
                return SINGULAR
            levels[k, DENSITY] = min(max(abs(det), 0.01), 100.0)
            into = small[5 + k]
            over = 1.0 / det
            into[0], into[1], into[2], into[3] = turn[3] * over, -turn[1] * over, -turn[2] * over, turn[0] * over
            moved[r, c, k] = math.sqrt(sx * sx + sy * sy)
        joint_weights(levels, variances, images, weights)
        # from pixels to the unknowns: B_k = (d reference px / d image px) (d image px / d unknown)
        xc, yc = undistort(lens1, x_px, y_px)
        ray, shift, at_state = small[8], small[9], small[10]
        ray[0], ray[1] = xc, yc
        shift[0], shift[1], along = state[5], state[6], state[7]
        if not along > 0.0:
            return SINGULAR
        for j in range(5):
            at_state[j] = state[j]
        slopes = small[12:18]
        positions(lens1, lens2, R, t, ray, at_state, shift, images, predicted, slopes)
        B, weighted = small[18:24], small[24:26]
        last = 5 if images == 3 else 2
        for k in range(images):
            into = small[5 + k]
            dx, dy = measured[2 * k] - predicted[2 * k], measured[2 * k + 1] - predicted[2 * k + 1]
            measured[2 * k] = into[0] * dx + into[1] * dy
            measured[2 * k + 1] = into[2] * dx + into[3] * dy
            for j in range(last):
                from_j = j if images == 3 else 4 * j
                a, b = slopes[2 * k, from_j], slopes[2 * k + 1, from_j]
                B[2 * k, j] = into[0] * a + into[1] * b
                B[2 * k + 1, j] = into[2] * a + into[3] * b
        N, pull, D = normal[0], small[3], weighted
        for j in range(last):
            pull[j] = 0.0
            for m in range(j + 1):
                N[j, m] = 0.0
        for k in range(images):
            tx, ty = 0.0, 0.0
            for o in range(images):
                tx += weights[k, o] * measured[2 * o]
                ty += weights[k, o] * measured[2 * o + 1]
            tx, ty = xx * tx + xy * ty, xy * tx + yy * ty
            for m in range(last):
                a, b = 0.0, 0.0
                for o in range(images):
                    a += weights[k, o] * B[2 * o, m]
                    b += weights[k, o] * B[2 * o + 1, m]
                D[0, m], D[1, m] = xx * a + xy * b, xy * a + yy * b
            for j in range(last):
                a, b = B[2 * k, j], B[2 * k + 1, j]
                pull[j] += a * tx + b * ty
                for m in range(j + 1):
                    N[j, m] += a * D[0, m] + b * D[1, m]
        if not factor(N, last):
            return SINGULAR
        L = normal[1]
        invert_lower(N, last, L)
        step = small[4]
        for j in range(last):
            z = 0.0
            for m in range(j + 1):
                z += L[j, m] * pull[m]
            step[j] = z
        for j in range(last):
            z = 0.0
            for m in range(j, last):
                z += L[m, j] * step[m]
            pull[j] = z
        if images == 3:
            for j in range(5):
                at_state[j] += pull[j]
        else:
            at_state[0] += pull[0]
            at_state[4] += pull[1]
        w0 = at_state[0]
        if not w0 > 0.0:
            return SINGULAR
        epipolar[r, c] = at_state[4]
        # px, as the ordinary fit judges: along and across camera 2's epipolar line, both ways in camera 1
        for j in range(last):
            z = 0.0
            for m in range(j, last):
                z += L[m, j] * L[m, j]
            step[j] = z
        sigma[r, c] = math.sqrt(max(step[0] * along * along, step[last - 1]))
        if images == 3:
            sigma[r, c] = max(sigma[r, c], math.sqrt(max(step[1], step[2])) * lens1[1] / at_state[3])
        # to the system frame, and L times the derivatives: covariance J L' L J'
        J = slopes
        for j in range(3):
            along_ray = (to_sys[j, 0] * xc + to_sys[j, 1] * yc + to_sys[j, 2]) / w0
            values[r, c, j] = along_ray + to_sys[j, 3]
            J[j, 0] = -along_ray / w0
            for m in range(1, 4):
                J[j, m] = 0.0
        if images == 3:
            for j in range(3):
                d0, d1, d2 = at_state[1] - xc, at_state[2] - yc, at_state[3] - 1.0
                motion = (to_sys[j, 0] * d0 + to_sys[j, 1] * d1 + to_sys[j, 2] * d2) / w0
                values[r, c, 3 + j] = motion
                J[3 + j, 0] = -motion / w0
                for m in range(3):
                    J[3 + j, 1 + m] = to_sys[j, m] / w0
        used = 4 if images == 3 else 1
        root = B
        n_values = 6 if images == 3 else 3
        for j in range(n_values):
            for m in range(last):
                z = 0.0
                for k in range(min(m + 1, used)):
                    z += L[m, k] * J[j, k]
                root[j, m] = z
        slot = 0
        for j in range(n_values):
            for k in range(j, n_values):
                z = 0.0
                for m in range(last):
                    z += root[j, m] * root[k, m]
                covariance[r, c, slot] = z
                slot += 1
        return OK

    @kernel(f"{images}")
    def band(first, last, given, space, out):
        """Compute rows ``first`` to ``last`` of vectors."""
        (
            reference,
            blocked,
            shown,
            lens1,
            lens2,
            R,
            t,
            to_sys,
            lattice,
            nodes,
            seen,
            cells,
            state,
            grey,
            subset,
            order,
            variances,
        ) = given
        ring, lines, tap, tx, ty, sums, windows, levels, weights, normal, small, local = space
        status = out.status
        cols = reference.pixels.shape[1]
        half = subset // 2
        blocks = np.int64((cols + LANES - 1) // LANES)
        for a in range(sums.shape[0]):
            for x in range(sums.shape[1]):
                sums[a, x] = 0.0
        cameras = (lens1, lens2, R, t, to_sys, variances)
        parts, of_row = (levels, weights, normal, small), (lines, tap, tx, ty)
        left = math.floor(lattice.x0 + 0.5)
        full = float(subset * subset)
        below = -1  # first row of pixels that is not summed yet
        per_px = 1.0 / lattice.spacing
        for r in range(first, last):
            y_px = lattice.y0 + r * lattice.step
            top = math.floor(y_px + 0.5) - half
            if below < 0:
                below = top
                origin = top
            for y in range(below, top + subset):
                slot = y % subset
                if y >= origin + subset:
                    add(ring[slot], -1.0, blocks, sums)
                _row_of_pixels(
                    y, reference, blocked, shown, lattice, nodes, seen, grey, order, images, ring[slot], of_row
                )
                add(ring[slot], 1.0, blocks, sums)
            below = top + subset
            start, n = left - half + lattice.first * lattice.step, lattice.last - lattice.first
            for a in range(n_columns):
                _slide(sums[a], start, subset, lattice.step, n, windows[a])
            along = r * lattice.step / lattice.spacing
            cell_r = min(int(along), cells.shape[0] - 1)
            v = along - cell_r
            for i in range(n):
                c = i + lattice.first
                across = c * lattice.step / lattice.spacing
                cell_c = min(int(across), cells.shape[1] - 1)
                u = across - cell_c
                if cells[cell_r, cell_c] == 0:
                    status[r, c] = MASKED
                    continue
                count = windows[q.COUNT, i]
                if count < full - 0.5 or count > full + 0.5:
                    missing = full - count
                    status[r, c] = OUTSIDE_IMAGE if missing - math.floor(missing) > 1e-6 else MASKED
                    continue
                x_px = lattice.x0 + c * lattice.step
                for j in range(8):
                    local[j] = (1.0 - v) * (
                        (1.0 - u) * state[cell_r, cell_c, j] + u * state[cell_r, cell_c + 1, j]
                    ) + v * ((1.0 - u) * state[cell_r + 1, cell_c, j] + u * state[cell_r + 1, cell_c + 1, j])
                at = (x_px, y_px, cell_r + lattice.rim, cell_c + lattice.rim, u, v)
                status[r, c] = vector(windows, i, at, per_px, cameras, nodes, local, parts, out, r, c)

    return DenseKernels(band, space)
