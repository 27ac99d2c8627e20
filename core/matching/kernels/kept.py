"""What a sequence keeps of a point's reference pair, so that a step neither sums nor compares it again.

The reference subset's sums are the same in all steps, to the last bit. Of camera 2's reference image the shape's result
is kept with the comparison there: about it the misfit is the quadratic form that Gauss-Newton takes it for anyhow, so
that near by the sums follow from the patch's displacement d in camera 2's image, with the Gram matrix A of the columns:

    sums(d) = sums + A d,    misfit(d) = misfit + (2 sums + A d) . d

What this leaves out is the convergence rate times d. A row of numbers a point; all zero where nothing is kept.
"""

from __future__ import annotations

from core.matching.kernels.naming import inner
from core.matching.kernels.noise import CONTRAST, DENSITY, MISFIT, SMOOTHED, ZNCC

KEPT_PX = 0.02
"""Displacement of camera 2's reference subset from the shape's result, at a corner, up to which its comparison is taken
from there: at the rates of usual images (0.01 to 0.06) a thousandth of a pixel is left out at most, and where points
are measured, some 0.005 px off, a hundredth of their noise."""
_FIRST = 5


def kept_width(terms: int) -> int:
    """Numbers a point, of patches with ``terms`` monomials (3 plane, 6 curved)."""
    n = 2 * terms
    return _FIRST + 2 * n + n * (n + 1) // 2 + n + 4 + terms + 1


@inner
def has_kept(kept):
    """True if a row holds anything: the weights' sum, its first number, is positive."""
    return kept.shape[0] > 0 and kept[0] > 0.0


@inner
def write_sums(kept, p, offset, f2, white, mean, sum_g, sum_fg, gram):
    """Keep the reference subset's sums."""
    n = sum_g.shape[0]
    kept[0], kept[1], kept[2], kept[3], kept[4] = p, offset, f2, white, mean
    at = _FIRST
    for i in range(n):
        kept[at + i], kept[at + n + i] = sum_g[i], sum_fg[i]
    at += 2 * n
    for i in range(n):
        for j in range(i, n):
            kept[at] = gram[i, j]
            at += 1


@inner
def read_sums(kept, sum_g, sum_fg, gram):
    """Fill the sums from what is kept; return the weights' sum, the offset, the squares' sum, the whiteness."""
    n = sum_g.shape[0]
    at = _FIRST
    for i in range(n):
        sum_g[i], sum_fg[i] = kept[at + i], kept[at + n + i]
    at += 2 * n
    for i in range(n):
        for j in range(i, n):
            gram[i, j] = gram[j, i] = kept[at]
            at += 1
    return kept[0], kept[1], kept[2], kept[3]


@inner
def _form_at(n):
    return _FIRST + 2 * n + n * (n + 1) // 2


@inner
def write_form(kept, rhs, levels, w, e, few):
    """Keep a comparison: its sums ``rhs`` (2 M,), its levels, and the unknowns it was made at."""
    n = 2 * few
    at = _form_at(n)
    for i in range(n):
        kept[at + i] = rhs[i]
    at += n
    kept[at], kept[at + 1], kept[at + 2], kept[at + 3] = (
        levels[MISFIT],
        levels[CONTRAST],
        levels[SMOOTHED],
        levels[DENSITY],
    )
    for j in range(few):
        kept[at + 4 + j] = w[j]
    kept[at + 4 + few] = e


@inner
def kept_offset(kept, few):
    """Epipolar offset, px, of the comparison that is kept."""
    return kept[_form_at(2 * few) + 2 * few + 4 + few]


@inner
def read_form(kept, few, each, columns, w, e, gram, f2, move, rhs, levels):
    """Fill sums and levels of the comparison from the one that is kept; False, and nothing, if it lies too far off.

    Parameters
    ----------
    few, each
        Monomials of the patch, and unknowns a monomial.
    columns
        (2 M, >= unknowns) each unknown's displacement of the patch.
    w, e
        The unknowns of the shape.
    gram, f2
        Of the reference subset.
    move
        (2 M,) work space.
    rhs, levels
        (2 M,) and (N_LEVELS,) of the comparison; its gain and shift stay.
    """
    n = 2 * few
    at = _form_at(n)
    last = at + n + 4
    de = e - kept[last + few]
    x, y = 0.0, 0.0
    for r in range(n):
        s = columns[r, each * few] * de
        for j in range(few):
            c = each * (j - 1) if j > 0 else each * (few - 1)
            s += columns[r, c] * (w[j] - kept[last + j])
        move[r] = s
        if r < few:
            x += abs(s)
        else:
            y += abs(s)
    if not x * x + y * y < KEPT_PX * KEPT_PX:
        return False
    change = 0.0
    for r in range(n):
        s = 0.0
        for c in range(n):
            s += gram[r, c] * move[c]
        change += (2.0 * kept[at + r] + s) * move[r]
        rhs[r] = kept[at + r] + s
    levels[MISFIT] = max(kept[at + n] + change, 0.0)
    levels[ZNCC] = 1.0 - 0.5 * levels[MISFIT] / f2
    levels[CONTRAST], levels[SMOOTHED], levels[DENSITY] = kept[at + n + 1], kept[at + n + 2], kept[at + n + 3]
    return True
