"""Intersections of straight lines with cuts and masks. Compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def meets(ax, ay, bx, by, pieces):
    """Return True if the line from a to b has a point in common with any of the pieces (m, 4)."""
    for m in range(pieces.shape[0]):
        cx, cy, dx, dy = pieces[m, 0], pieces[m, 1], pieces[m, 2], pieces[m, 3]
        if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx):
            continue
        if max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
            continue
        # boxes that overlap, and each has the other's ends on two sides, or on itself
        of_c = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        of_d = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
        of_a = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
        of_b = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
        if of_c * of_d <= 0.0 and of_a * of_b <= 0.0:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def cross(first, last, a, b, pieces, out):
    """Fill ``out`` (n,) bool: True where the line from a (n, 2) to b (n, 2) meets any of the pieces (m, 4)."""
    for i in range(first, last):
        out[i] = meets(a[i, 0], a[i, 1], b[i, 0], b[i, 1], pieces)


@njit(cache=True, nogil=True, error_model="numpy")
def stays_white(ax, ay, bx, by, white):
    """Return True if the line from a to b stays on the white of a mask (rows, cols), which may be empty: no mask.

    Sampled every half pixel or closer; pixels off the mask's array count as white.
    """
    rows, cols = white.shape
    if rows == 0:
        return True
    steps = math.ceil(2.0 * max(abs(bx - ax), abs(by - ay)))
    for s in range(steps + 1):
        t = s / steps if steps > 0 else 0.0
        c, r = math.floor(ax + t * (bx - ax) + 0.5), math.floor(ay + t * (by - ay) + 0.5)
        if 0 <= c < cols and 0 <= r < rows and white[r, c] == 0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def find_separated(first, last, a, b, pieces, white, out):
    """Fill ``out`` (n,) bool: True where the line from a to b (n, 2) meets a piece or leaves the white."""
    for i in range(first, last):
        out[i] = meets(a[i, 0], a[i, 1], b[i, 0], b[i, 1], pieces) or not stays_white(
            a[i, 0], a[i, 1], b[i, 0], b[i, 1], white
        )


@njit(cache=True, nogil=True, error_model="numpy")
def separated_neighbours(first, last, x, y, reach, pieces, white, out):
    """Fill ``out`` (r, c) uint32: bit k is set where neighbour k is separated from a point.

    Neighbours in rows and columns from -reach to reach, row by row, the point itself left out.
    """
    rows, cols = x.shape
    for r in range(first, last):
        for c in range(cols):
            bits, bit = np.uint32(0), np.uint32(1)
            for dr in range(-reach, reach + 1):
                for dc in range(-reach, reach + 1):
                    if dr == 0 and dc == 0:
                        continue
                    i, j = r + dr, c + dc
                    inside = 0 <= i < rows and 0 <= j < cols
                    if inside and (
                        meets(x[r, c], y[r, c], x[i, j], y[i, j], pieces)
                        or not stays_white(x[r, c], y[r, c], x[i, j], y[i, j], white)
                    ):
                        bits |= bit
                    bit <<= np.uint32(1)
            out[r, c] = bits


@njit(cache=True, nogil=True, error_model="numpy")
def passes_box(piece, x0, y0, x1, y1):
    """Return True if a piece (4,) has a point in a box (Liang and Barsky's clipping, doi:10.1145/357332.357333)."""
    t0, t1 = 0.0, 1.0
    for k in range(2):
        start, along = piece[k], piece[2 + k] - piece[k]
        low, high = (x0, x1) if k == 0 else (y0, y1)
        if along == 0.0:
            if start < low or start > high:
                return False
            continue
        a, b = (low - start) / along, (high - start) / along
        t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
        if t0 > t1:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def squared_distance(x, y, piece):
    """Return the square of the distance of a point from a piece (4,)."""
    ux, uy = piece[2] - piece[0], piece[3] - piece[1]
    length = ux * ux + uy * uy
    t = ((x - piece[0]) * ux + (y - piece[1]) * uy) / length if length > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    dx, dy = x - piece[0] - t * ux, y - piece[1] - t * uy
    return dx * dx + dy * dy


@njit(cache=True, nogil=True, error_model="numpy")
def find_near(first, last, xy, subset, margin, pieces, black_sums, out):
    """Fill ``out`` (n,) bool: True if a piece or black pixels are in a point's subset or within ``margin`` px of it.

    ``black_sums`` is the integral image of the mask's black, (rows + 1, cols + 1), or empty.
    """
    half = 0.5 * (subset - 1) + margin
    rows, cols = black_sums.shape[0] - 1, black_sums.shape[1] - 1
    for i in range(first, last):
        x, y = xy[i, 0], xy[i, 1]
        near = False
        if rows > 0:
            left, right = math.floor(x - half - 0.5), math.ceil(x + half + 0.5) + 1
            top, bottom = math.floor(y - half - 0.5), math.ceil(y + half + 0.5) + 1
            left, right = min(max(left, 0), cols), min(max(right, 0), cols)
            top, bottom = min(max(top, 0), rows), min(max(bottom, 0), rows)
            near = (
                black_sums[bottom, right] - black_sums[top, right] - black_sums[bottom, left] + black_sums[top, left]
            ) > 0
        for m in range(pieces.shape[0]):
            if near:
                break
            # the subset's pixels are centred on the pixel nearest to the point
            near = passes_box(pieces[m], x - half - 0.5, y - half - 0.5, x + half + 0.5, y + half + 0.5)
        out[i] = near


@njit(cache=True, nogil=True, error_model="numpy")
def mark_visible(first, last, xy, subset, margin, pieces, white, clear, patches, counts):
    """Fill ``patches`` (n, subset, subset) uint8: 1 where the pixel is visible from the point and may count.

    Parameters
    ----------
    first, last
        Range of points.
    xy
        (n, 2) points.
    subset, margin
        Width of the subset, and distance to a piece below which no pixel counts, px.
    pieces
        (m, 4).
    white, clear
        The mask's white, along which lines must stay, and the part of it that may count; both empty without a mask.
    patches, counts
        Out; counts (n,) int32 the number of ones.
    """
    rows, cols = white.shape
    half = 0.5 * (subset - 1)
    near = np.empty(pieces.shape)
    for i in range(first, last):
        x, y = xy[i, 0], xy[i, 1]
        left, top = math.floor(x - half + 0.5), math.floor(y - half + 0.5)
        n_near = 0
        reach = half + margin + 0.5
        for m in range(pieces.shape[0]):
            if passes_box(pieces[m], x - reach, y - reach, x + reach, y + reach):
                for k in range(4):
                    near[n_near, k] = pieces[m, k]
                n_near += 1
        local = near[:n_near]
        count = 0
        for r in range(subset):
            for c in range(subset):
                px, py = float(left + c), float(top + r)
                seen = True
                if rows > 0 and 0 <= top + r < rows and 0 <= left + c < cols:
                    seen = clear[top + r, left + c] != 0
                for m in range(n_near):
                    if not seen:
                        break
                    seen = squared_distance(px, py, local[m]) >= margin * margin
                seen = seen and not meets(x, y, px, py, local) and stays_white(x, y, px, py, white)
                patches[i, r, c] = 1 if seen else 0
                count += 1 if seen else 0
        counts[i] = count


@njit(cache=True, nogil=True, error_model="numpy")
def variances(first, last, image, xy, patches, out):
    """Fill ``out`` (n,): variance of an image's grey levels over the pixels that count of each point's patch."""
    subset = patches.shape[1]
    half = 0.5 * (subset - 1)
    rows, cols = image.shape
    for i in range(first, last):
        left, top = math.floor(xy[i, 0] - half + 0.5), math.floor(xy[i, 1] - half + 0.5)
        n, s, ss, base = 0, 0.0, 0.0, 0.0
        for r in range(subset):
            for c in range(subset):
                if patches[i, r, c] != 0 and 0 <= top + r < rows and 0 <= left + c < cols:
                    g = float(image[top + r, left + c])
                    if n == 0:
                        base = g
                    n += 1
                    s += g - base
                    ss += (g - base) ** 2
        out[i] = max(ss - s * s / n, 0.0) / n if n > 0 else 0.0
