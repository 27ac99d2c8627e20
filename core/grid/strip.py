"""The strip of pixels about one piece of a line: its pixels, and the line's place across it."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit

from stereorig.core.arrays import Float, Float32

# columns of the table of pieces
INPUTS = (
    "x",
    "y",
    "dir_x",
    "dir_y",
    "half_length",
    "bend",
    "start_x",
    "start_y",
    "start_nx",
    "start_ny",
    "end_x",
    "end_y",
    "end_nx",
    "end_ny",
    "width",
    "blur",
    "search",
    "room",
)
IN = {name: k for k, name in enumerate(INPUTS)}


@njit(cache=True, nogil=True)
def strip_bounds(piece: Float, half_width: float, rows: int, cols: int) -> tuple[int, int, int, int]:
    """Pixel box (x0, x1, y0, y1), half open, that holds the piece's strip."""
    dx, dy, h = abs(piece[2]), abs(piece[3]), piece[4]
    rx = dx * h + dy * half_width + 1.0
    ry = dy * h + dx * half_width + 1.0
    x0 = max(0, int(np.floor(piece[0] - rx)))
    x1 = min(cols, int(np.ceil(piece[0] + rx)) + 1)
    y0 = max(0, int(np.floor(piece[1] - ry)))
    y1 = min(rows, int(np.ceil(piece[1] + ry)) + 1)
    return x0, x1, y0, y1


@njit(cache=True, nogil=True)
def in_strip(piece: Float, x: float, y: float, half_width: float, guard: float) -> tuple[bool, float, float]:
    """Return True for a pixel in the piece's strip, away from both crossings, and its t and d."""
    ex, ey = x - piece[0], y - piece[1]
    t = ex * piece[2] + ey * piece[3]
    d = -ex * piece[3] + ey * piece[2] - piece[5] * t * t
    if abs(t) > piece[4] or abs(d) > half_width:
        return False, t, d
    if abs((x - piece[6]) * piece[8] + (y - piece[7]) * piece[9]) < guard:
        return False, t, d
    if abs((x - piece[10]) * piece[12] + (y - piece[11]) * piece[13]) < guard:
        return False, t, d
    return True, t, d


@njit(cache=True, nogil=True)
def search_across(image: Float32, piece: Float, guard: float, sign: float) -> float:
    """Find the deepest mean profile of the strip in the search range, by a box of the line's width."""
    search = piece[16]
    reach = search + 2.0 + piece[14]
    n_bin = 2 * int(np.ceil(2.0 * reach)) + 1
    mid = n_bin // 2
    total = np.zeros(n_bin)
    count = np.zeros(n_bin)
    x0, x1, y0, y1 = strip_bounds(piece, reach, image.shape[0], image.shape[1])
    for y in range(y0, y1):
        for x in range(x0, x1):
            inside, _, d = in_strip(piece, float(x), float(y), reach, guard)
            if inside:
                k = mid + int(np.floor(2.0 * d + 0.5))
                if 0 <= k < n_bin:
                    total[k] += sign * image[y, x]
                    count[k] += 1.0
    half = max(1, int(np.floor(piece[14] + 0.5)))
    best, at = -np.inf, 0.0
    for k in range(mid - int(2.0 * search), mid + int(2.0 * search) + 1):
        inner, n_in, outer, n_out = 0.0, 0.0, 0.0, 0.0
        for m in range(k - half - 4, k + half + 5):
            if 0 <= m < n_bin and count[m] > 0.0:
                if abs(m - k) <= half:
                    inner += total[m]
                    n_in += count[m]
                elif abs(m - k) > half + 1:
                    outer += total[m]
                    n_out += count[m]
        if n_in > 0.0 and n_out > 0.0:
            value = inner / n_in - outer / n_out
            if value > best:
                best, at = value, 0.5 * (k - mid)
    return at


@njit(cache=True, nogil=True)
def strip_reach(piece: Float, guard_blurs: float) -> tuple[float, float]:
    """Half width of the piece's strip, and the guard to both crossings."""
    width, blur = piece[14], piece[15]
    spread = sqrt(blur * blur + 1.0 / 12.0)
    guard = 0.5 * width + guard_blurs * spread
    return max(min(0.5 * width + 5.0 * spread + 1.0, piece[17]), 0.5 * width + 2.0 * spread), guard


@njit(cache=True, nogil=True)
def strip_pixels(
    image: Float32, piece: Float, reach: tuple[float, float], shift: float, ts: Float, ds: Float, gs: Float
) -> int:
    """Fill in t, d and grey level of the pixels in a strip ``shift`` across from the piece; return their number."""
    half_width, guard = reach
    moved = piece.copy()
    moved[0] += -piece[3] * shift
    moved[1] += piece[2] * shift
    x0, x1, y0, y1 = strip_bounds(piece, half_width + abs(shift), image.shape[0], image.shape[1])
    n = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            inside, t, d = in_strip(moved, float(x), float(y), half_width, guard)
            if inside:
                ts[n] = t
                ds[n] = d + shift
                gs[n] = image[y, x]
                n += 1
    return n
