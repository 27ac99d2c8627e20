"""Maximum-likelihood fit of one piece of a line, by the profile of a straight line in square pixels.

A line of width w, blurred by a Gaussian of standard deviation s and integrated over square pixels, crosses the
piece's normal (n_x, n_y) with the profile

    P(d) = (1 / (|n_x| |n_y|)) sum over signs of  +-G2(d +- w/2 +- |n_x|/2 +- |n_y|/2),   G2'' = Phi(d / s)

since a square pixel, seen along the line, is the convolution of two boxes of widths |n_x| and |n_y|. The grey level
is

    I = B + B_t t + B_d d + A P(d - c0 - c1 t)

with distance along the piece t and across it d, from a base parabola. With Gaussian noise, least squares maximises the
likelihood. P is even, so that width and blur are not correlated with the position c0, c1.
"""

from __future__ import annotations

from math import erf, exp, sqrt

import numpy as np
from numba import njit

from stereorig.core.arrays import Float, Float32
from stereorig.core.grid.strip import search_across, strip_bounds, strip_pixels, strip_reach

# columns of the table of fits
OUTPUTS = (
    "c0",
    "c1",
    "var_c0",
    "cov_c01",
    "var_c1",
    "amplitude",
    "var_amplitude",
    "ground",
    "ground_t",
    "ground_d",
    "blur",
    "width",
    "rms",
    "n_pixels",
    "brightest",
    "ok",
    "peak",
)
OUT = {name: k for k, name in enumerate(OUTPUTS)}

_STEPS = 12
GUARD_BLURS = 5.0  # from a crossing line
N_SHAPE = 8  # c0, c1, B, B_t, B_d, A, s, w
WIDTH_SEEN = 1.5  # px; narrower lines' width cannot be distinguished from their depth
WIDTH_PRIOR = 0.15  # relative standard deviation of the described width
_MAX_BLUR = 8.0
_MIN_PIXELS = 20
_SEARCHED_PIXELS = 500
_MANY_PIXELS = 2000  # pixels of a piece; a part of them leads all to within a step of their minimum
_NO_GAIN = 1e-7  # share of the sum of squares: hundredths of a standard deviation
MIN_BOX = 0.01  # px; narrower boxes, of lines along the rows or columns, change the profile by 1e-5 of itself


@njit(cache=True, nogil=True)
def profile_terms(d: float, width: float, blur: float, a: float, b: float) -> tuple[float, float, float, float]:
    """Return P, dP/dd, dP/ds and dP/dw at the distance d."""
    p = 0.0
    pd = 0.0
    pdd = 0.0
    pw = 0.0
    r2 = 1.0 / (blur * 1.4142135623730951)
    g0 = blur * 0.3989422804014327
    s2 = blur * blur
    for k in range(8):
        ew = 1.0 if k & 1 else -1.0
        ea = 1.0 if k & 2 else -1.0
        eb = 1.0 if k & 4 else -1.0
        sign = ew * ea * eb
        u = d + 0.5 * (ew * width + ea * a + eb * b)
        z = u * r2
        if z > 6.0:
            phi0 = 1.0
            g = 0.0
        elif z < -6.0:
            continue
        else:
            phi0 = 0.5 * (1.0 + erf(z))
            g = g0 * exp(-z * z)
        g1 = u * phi0 + g
        p += sign * 0.5 * ((u * u + s2) * phi0 + u * g)
        pd += sign * g1
        pw += sign * ew * 0.5 * g1
        pdd += sign * phi0
    f = 1.0 / (a * b)
    return p * f, pd * f, blur * pdd * f, pw * f


@njit(cache=True, nogil=True)
def solve_cholesky(M: Float, b: Float, x: Float) -> bool:
    """Solve M x = b by Cholesky, overwriting M; False if M is not positive definite (a saturated or empty piece)."""
    n = M.shape[0]
    for i in range(n):
        top = M[i, i]
        for j in range(i + 1):
            total = M[i, j]
            for k in range(j):
                total -= M[i, k] * M[j, k]
            if i == j:
                if not total > 1e-13 * top:
                    return False
                M[i, i] = sqrt(total)
            else:
                M[i, j] = total / M[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= M[i, k] * x[k]
        x[i] = total / M[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= M[k, i] * x[k]
        x[i] = total / M[i, i]
    return True


@njit(cache=True, nogil=True)
def model_row(par: Float, t: float, d: float, scale: float, a: float, b: float, fit_width: bool, J: Float) -> float:
    """Grey level at t, d; its derivatives J by c0, c1, B, B_t, B_d, A, s, w, where c1 and B_t multiply ``scale`` t."""
    p, pd, ps, pw = profile_terms(d - par[0] - par[1] * t * scale, par[7], par[6], a, b)
    J[0] = -par[5] * pd
    J[1] = J[0] * t * scale
    J[2] = 1.0
    J[3] = t * scale
    J[4] = d
    J[5] = p
    J[6] = par[5] * ps
    J[7] = par[5] * pw if fit_width else 0.0
    return float(par[2] + par[3] * J[3] + par[4] * d + par[5] * p)


@njit(cache=True, nogil=True)
def close_normal(N: Float, fit_width: bool, width: float, variance: float) -> float:
    """Add the priors and fill in the lower half of the normal matrix; return the width's weight."""
    prior = 0.0
    if fit_width:
        # without the description's width, a line of two pixels trades its width for depth and blur
        prior = variance / (WIDTH_PRIOR * width) ** 2
        N[7, 7] += prior
    else:
        N[7, 7] = 1.0
    # slight damping on the shape keeps the matrix regular when blur or contrast are undetermined
    N[6, 6] *= 1.0 + 1e-6
    N[6, 6] += 1e-9
    for i in range(N_SHAPE):
        for j in range(i):
            N[i, j] = N[j, i]
    return prior


@njit(cache=True, nogil=True)
def _copy(source: Float, to: Float) -> None:
    """Copy (n,) numbers; ``to[:] = source`` would have the text of an error that cannot be compiled, for seconds."""
    for k in range(source.size):
        to[k] = source[k]


@njit(cache=True, nogil=True)
def _minimise(
    ts: Float,
    ds: Float,
    gs: Float,
    n: int,
    every: int,
    a: float,
    b: float,
    scale: float,
    width: float,
    fit_width: bool,
    par: Float,
    accepted: Float,
    led: bool,
) -> float:
    """Fit ``par`` to every ``every``-th pixel; return the sum of squares, inf without a minimum.

    ``accepted`` becomes the normal matrix at ``par``. ``led``: ``par`` is near the minimum already.
    """
    count = (n + every - 1) // every
    N = np.zeros((N_SHAPE, N_SHAPE))
    g = np.zeros(N_SHAPE)
    J = np.zeros(N_SHAPE)
    trial = par.copy()
    delta = np.zeros(N_SHAPE)
    lam = 0.0
    best = np.inf
    kept = False
    for step in range(_STEPS):
        N[:] = 0.0
        g[:] = 0.0
        rss = 0.0
        for k in range(0, n, every):
            r = gs[k] - model_row(trial, ts[k], ds[k], scale, a, b, fit_width, J)
            rss += r * r
            for i in range(N_SHAPE):
                g[i] += J[i] * r
                for j in range(i, N_SHAPE):
                    N[i, j] += J[i] * J[j]
        if not rss <= best * (1.0 + 1e-9):  # also NaN
            if step == 0:
                return np.inf
            lam = max(4.0 * lam, 1e-3)
            # half way back
            for i in range(N_SHAPE):
                trial[i] = 0.5 * (trial[i] + par[i])
            continue
        settled = kept and best - rss < 1e-7 * best
        best = rss
        kept = True
        _copy(trial, par)
        prior = close_normal(N, fit_width, width, rss / (count - N_SHAPE))
        g[7] = g[7] + prior * (width - par[7]) if fit_width else 0.0
        _copy(N.ravel(), accepted.ravel())
        if settled or step == _STEPS - 1:
            break
        M = N.copy()
        for i in range(N_SHAPE):
            M[i, i] *= 1.0 + lam
            if not M[i, i] > 0.0:
                return np.inf
        if not solve_cholesky(M, g, delta):
            return np.inf
        lam *= 0.2
        for i in range(N_SHAPE):
            trial[i] = par[i] + delta[i]
        trial[0] = min(max(trial[0], par[0] - 1.0), par[0] + 1.0)
        trial[6] = min(max(trial[6], max(0.08, 0.5 * par[6])), min(_MAX_BLUR, 2.0 * par[6] + 0.1))
        trial[7] = min(max(trial[7], 0.6 * par[7]), 1.6 * par[7])
        if led and step > 0 and lam == 0.0:
            # a step that is foreseen to gain next to nothing is made, and not looked back at
            gain = 0.0
            for i in range(N_SHAPE):
                gain += delta[i] * g[i]
            if gain < _NO_GAIN * best:
                _copy(trial, par)
                break
    return best


@njit(cache=True, nogil=True)
def _fit_piece(image: Float32, piece: Float, guard_blurs: float, sign: float, out: Float) -> None:
    out[:] = np.nan
    out[15] = 0.0
    width, blur = piece[14], piece[15]
    fit_width = width > WIDTH_SEEN
    a, b = max(abs(piece[2]), MIN_BOX), max(abs(piece[3]), MIN_BOX)
    reach = strip_reach(piece, guard_blurs)
    half_width = reach[0]
    # the strip is centred on the line, or its ground would be tilted
    c0 = search_across(image, piece, reach[1], sign) if piece[16] > 0.0 else 0.0
    x0, x1, y0, y1 = strip_bounds(piece, half_width + abs(c0), image.shape[0], image.shape[1])
    room = (x1 - x0) * (y1 - y0)
    if room <= 0:
        return
    ts = np.empty(room)
    ds = np.empty(room)
    gs = np.empty(room)
    n = strip_pixels(image, piece, reach, c0, ts, ds, gs)
    if n < _MIN_PIXELS:
        return
    brightest = gs[:n].max()
    if piece[16] > 0.0 and n > 2 * _SEARCHED_PIXELS:
        # a first fit of a long piece only finds it for the second
        every = n // _SEARCHED_PIXELS
        n = n // every
        for k in range(n):
            ts[k], ds[k], gs[k] = ts[k * every], ds[k * every], gs[k * every]
    out[7] = gs[:n].mean()  # kept also where the fit fails: it distinguishes glare from dirt
    out[14] = brightest
    scale = 1.0 / max(piece[4], 1.0)
    par = np.zeros(N_SHAPE)
    par[0] = c0
    par[6] = blur
    par[7] = width
    # start of the linear part: ground from the outer half of the strip
    ground, n_ground, line, n_line = 0.0, 0, 0.0, 0
    for k in range(n):
        if abs(ds[k] - c0) > 0.5 * (width + half_width) * 0.5 + 0.5:
            ground += gs[k]
            n_ground += 1
        elif abs(ds[k] - c0) < 0.5 * width + 0.3:
            line += gs[k]
            n_line += 1
    if n_ground == 0 or n_line == 0:
        return
    par[2] = ground / n_ground
    peak, _, _, _ = profile_terms(0.0, width, blur, a, b)
    par[5] = (line / n_line - par[2]) / max(peak, 0.1)
    accepted = np.zeros((N_SHAPE, N_SHAPE))
    # one call, since numba would compile another for each constant among its arguments
    led, start, best = False, par.copy(), np.inf
    for turn in range(0 if n > _MANY_PIXELS else 1, 2):
        every = n // _SEARCHED_PIXELS if turn == 0 else 1
        best = _minimise(ts, ds, gs, n, every, a, b, scale, width, fit_width, par, accepted, led)
        led = np.isfinite(best)
        if not led:
            _copy(start, par)
    if not np.isfinite(best):
        return
    J, delta, C = np.zeros(N_SHAPE), np.zeros(N_SHAPE), np.zeros((N_SHAPE, N_SHAPE))
    dof = n - (N_SHAPE if fit_width else N_SHAPE - 1)
    variance = best / dof
    for j in range(N_SHAPE):  # inverse, column by column
        M = accepted.copy()
        J[:] = 0.0
        J[j] = 1.0
        if not solve_cholesky(M, J, delta):
            return
        _copy(delta, C[:, j])
    peak, _, _, _ = profile_terms(0.0, par[7], par[6], a, b)
    out[0] = par[0]
    out[1] = par[1] * scale
    out[2] = C[0, 0] * variance
    out[3] = C[0, 1] * variance * scale
    out[4] = C[1, 1] * variance * scale * scale
    out[5] = par[5]
    out[6] = C[5, 5] * variance
    out[7] = par[2]
    out[8] = par[3] * scale
    out[9] = par[4]
    out[10] = par[6]
    out[11] = par[7]
    out[12] = sqrt(variance)
    out[13] = n
    out[14] = brightest
    out[15] = 1.0
    out[16] = peak


@njit(cache=True, nogil=True)
def _fit_pieces(image: Float32, pieces: Float, guard_blurs: float, sign: float, out: Float) -> None:
    for k in range(pieces.shape[0]):
        _fit_piece(image, pieces[k], guard_blurs, sign, out[k])


def fit_pieces(image: Float32, pieces: Float, *, dark_lines: bool) -> Float:
    """Fit every piece of the table.

    Parameters
    ----------
    image
        (rows, columns) float32 grey levels.
    pieces
        (n, :data:`stereorig.core.grid.strip.INPUTS`) base lines, crossings, start values; pixels, and unit vectors.
    dark_lines
        Sign of the contrast searched for.

    Returns
    -------
    Float
        (n, :data:`OUTPUTS`); NaN and ``ok`` = 0 where a piece has too few pixels or no minimum.
    """
    out = np.empty((len(pieces), len(OUTPUTS)))
    table = np.ascontiguousarray(pieces, dtype=np.float64)
    _fit_pieces(image, table, GUARD_BLURS, -1.0 if dark_lines else 1.0, out)
    return out
