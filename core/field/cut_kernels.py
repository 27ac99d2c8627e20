"""What can be seen from where: lines that meet cuts. Compiled."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def meets(ax, ay, bx, by, pieces):
    """Whether the line from a to b has a point in common with any of the pieces (m, 4)."""
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
    """Fill ``out`` (n,) bool: whether the lines from a (n, 2) to b (n, 2) meet any of the pieces (m, 4)."""
    for i in range(first, last):
        out[i] = meets(a[i, 0], a[i, 1], b[i, 0], b[i, 1], pieces)
