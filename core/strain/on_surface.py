"""Windows' slopes on the surface, compiled: the strain, its derivatives, and the propagation of noise into it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.matching.kernels.naming import entry, entry_with_arrays, inner
from stereorig.core.matching.moved import cross, dense, dot, fill_frame
from stereorig.core.settings import StrainTensor
from stereorig.core.strain.tensors import hencky_of_green, hencky_slope


@inner
def _fill_bias(slope, second, moments, normal, out):
    """Fill ``out`` (3, 2) with the bias of slopes (3, 2) that the surface's bend makes, see :mod:`.strain.arcs`."""
    x, p = slope[:, 0], slope[:, 1]
    cross(x, p, normal)
    aa, ab, bb = dot(x, x), dot(x, p), dot(p, p)
    per = 1.0 / dot(normal, normal)  # the metric's determinant, and the normal's square
    root = math.sqrt(per)
    ss, st = root * dot(normal, second[:, 0]), root * dot(normal, second[:, 1])
    tt = root * dot(normal, second[:, 2])
    for k in range(2):
        m = moments[k]
        # the third derivatives along the two slopes
        one = m[0] * ss * ss + m[1] * ss * st + m[2] * st * st + m[3] * tt * st
        two = m[0] * ss * st + m[1] * st * st + m[2] * tt * st + m[3] * tt * tt
        along, across = (ab * two - bb * one) * per, (ab * one - aa * two) * per
        for i in range(3):
            out[i, k] = along * x[i] + across * p[i]


@entry_with_arrays
def _fill(slopes, seconds, moments, towards, infinitesimal, frames, per_mm, gradients, strains, pulls):
    """Fill the arrays of :class:`OnSurface`; Green-Lagrange strain unless ``infinitesimal``."""
    before, now, at, normal = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2)), np.empty(3)
    moved, product = np.empty((3, 2)), np.empty((2, 2))
    for n in range(len(slopes)):
        slope, frame, grid, gradient = slopes[n], frames[n], per_mm[n], gradients[n]
        for i in range(3):
            for k in range(2):
                at[i, k] = slope[i, k] + slope[3 + i, k]
        _fill_bias(slope[:3], seconds[n, :3], moments[n], normal, before)
        _fill_bias(at, seconds[n, 3:], moments[n], normal, now)
        for i in range(3):
            for k in range(2):
                at[i, k] = slope[i, k] - before[i, k]
        cross(at[:, 0], at[:, 1], normal)
        if dot(normal, towards[n]) < 0.0:
            for i in range(3):
                normal[i] = -normal[i]
        fill_frame(normal, frame)
        a, b = dot(frame[:, 0], at[:, 0]), dot(frame[:, 0], at[:, 1])
        c, d = dot(frame[:, 1], at[:, 0]), dot(frame[:, 1], at[:, 1])
        per = 1.0 / (a * d - b * c)
        grid[0, 0], grid[0, 1], grid[1, 0], grid[1, 1] = d * per, -b * per, -c * per, a * per
        for i in range(3):
            u = slope[3 + i, 0] - (now[i, 0] - before[i, 0])
            v = slope[3 + i, 1] - (now[i, 1] - before[i, 1])
            for k in range(2):
                gradient[i, k] = u * grid[0, k] + v * grid[1, k]
                moved[i, k] = frame[i, k] + gradient[i, k]
        one, two = gradient[:, 0], gradient[:, 1]
        strain = strains[n]
        strain[0], strain[1] = dot(frame[:, 0], one), dot(frame[:, 1], two)
        strain[2] = 0.5 * (dot(frame[:, 0], two) + dot(frame[:, 1], one))
        left = frame if infinitesimal else moved
        for i in range(2):
            for j in range(2):
                product[i, j] = dot(left[:, i], moved[:, j])
        if not infinitesimal:
            strain[0] += 0.5 * dot(one, one)
            strain[1] += 0.5 * dot(two, two)
            strain[2] += 0.5 * dot(one, two)
        for k in range(2):
            # an infinitesimal strain's frame tilts with the positions, see stereorig.core.strain.tensors.pulls_of
            tilt = dot(normal, moved[:, k]) if infinitesimal else 0.0
            for i in range(3):
                own = frame[i, 0] * product[k, 0] + frame[i, 1] * product[k, 1]
                pulls[n, k, i] = left[i, k] - own + tilt * normal[i]
                pulls[n, k, 3 + i] = left[i, k]


@entry
def _fill_covariance(pulls, per_mm, points, spreads, out):
    """Covariance ``out`` (n, 3, 3) of exx, eyy, exy; spreads (n, 2, 2) in grid steps."""
    for n in range(len(out)):
        g, s, p = per_mm[n], spreads[n], points[n]
        q11, q12, q22 = 0.0, 0.0, 0.0
        for i in range(6):
            one, two = 0.0, 0.0
            for j in range(6):
                one += p[i, j] * pulls[n, 0, j]
                two += p[i, j] * pulls[n, 1, j]
            q11 += pulls[n, 0, i] * one
            q12 += pulls[n, 0, i] * two
            q22 += pulls[n, 1, i] * two
        a, b = s[0, 0] * g[0, 0] + s[0, 1] * g[1, 0], s[1, 0] * g[0, 0] + s[1, 1] * g[1, 0]
        c, d = s[0, 0] * g[0, 1] + s[0, 1] * g[1, 1], s[1, 0] * g[0, 1] + s[1, 1] * g[1, 1]
        k11, k12, k22 = g[0, 0] * a + g[1, 0] * b, g[0, 0] * c + g[1, 0] * d, g[0, 1] * c + g[1, 1] * d
        V = out[n]
        V[0, 0], V[1, 1] = k11 * q11, k22 * q22
        V[2, 2] = 0.25 * (k22 * q11 + k11 * q22 + 2.0 * k12 * q12)
        V[0, 1] = V[1, 0] = k12 * q12
        V[0, 2] = V[2, 0] = 0.5 * (k12 * q11 + k11 * q12)
        V[1, 2] = V[2, 1] = 0.5 * (k22 * q12 + k12 * q22)


@dataclass(frozen=True, eq=False)
class OnSurface:
    """Windows' slopes on the surface, at the n points that have a strain.

    Attributes
    ----------
    frame
        (n, 3, 2) unit tangents.
    per_mm
        (n, 2, 2) steps of column and row (first index) per mm along them.
    gradient
        (n, 3, 2) the displacement's derivatives along them.
    around
        (n, 6, 6) the points' covariance, mean over each window.
    strain
        (n, 3) exx, eyy, exy.
    pulls
        (n, 2, 6) of :func:`stereorig.core.strain.tensors.pulls_of`.
    """

    frame: Float
    per_mm: Float
    gradient: Float
    around: Float
    strain: Float
    pulls: Float

    @staticmethod
    def of(
        slope: Float, second: Float, moments: Float, towards: Float, around: Float, tensor: StrainTensor
    ) -> OnSurface:
        """Return the slopes on the surface, without the bias that its bend makes in them.

        Parameters
        ----------
        slope, second, moments
            (n, 6, 2), (n, 6, 3) and (n, 2, 4), as of :class:`stereorig.core.strain.window.Slopes`.
        towards
            (n, 3) the side of the surface that its normal is on.
        around
            (n, 6, 6) the points' covariance, mean over each window.
        tensor
            Which strain.
        """
        n = len(slope)
        given = (dense(a) for a in (slope, second, moments, towards))
        frame, per_mm, gradient = np.empty((n, 3, 2)), np.empty((n, 2, 2)), np.empty((n, 3, 2))
        strain, pulls = np.empty((n, 3)), np.empty((n, 2, 6))
        _fill(*given, tensor == "infinitesimal", frame, per_mm, gradient, strain, pulls)
        if tensor == "hencky":
            strain = hencky_of_green(strain)
        return OnSurface(frame, per_mm, gradient, around, strain, pulls)

    def covariance(self, spread: Float, tensor: StrainTensor, at: np.ndarray | slice = slice(None)) -> Float:
        """Covariance (m, 3, 3) of the strain of some points, from the spread (m, 2, 2) of the slopes in grid steps."""
        return strain_covariance(self.pulls[at], tensor, self.around[at], (self.per_mm[at], spread), self.strain[at])


def strain_covariance(
    pulls: Float, tensor: StrainTensor, points: Float, spread: tuple[Float, Float], strain: Float
) -> Float:
    """Return the covariance (n, 3, 3) of exx, eyy, exy.

    Parameters
    ----------
    pulls
        (n, 2, 6) of :func:`stereorig.core.strain.tensors.pulls_of`.
    tensor
        Which strain.
    points
        (n, 6, 6) covariance of X Y Z U V W of the window's points.
    spread
        (n, 2, 2) steps of column and row per mm, and (n, 2, 2) sum over pairs of points of c_k rho_kl c_l^T, c the
        points' weights in the slopes, in grid steps, and rho the correlation of their errors.
    strain
        (n, 3) the strain itself.

    Notes
    -----
    An error of the positions changes the tangents by d_j = sum c_kj (dX, dU)_k, six numbers for each of j = 1, 2. The
    strain follows as de_ij = 1/2 (A_i . d_j + A_j . d_i), and cov(d_i, d_j) = spread_ij points.
    """
    out = np.empty((len(pulls), 3, 3))
    _fill_covariance(*(dense(a) for a in (pulls, spread[0], points, spread[1])), out)
    if tensor == "hencky":
        J = hencky_slope(strain)
        out = J @ out @ np.swapaxes(J, -1, -2)
    return out
