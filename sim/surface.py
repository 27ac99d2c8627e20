"""Analytic surfaces and their deformation: material point (s, t) -> place in the body's frame, with derivatives.

The body's frame has z pointing away from the cameras, like the system frame; a scene's pose puts the body into the
system frame. (s, t) are material coordinates in mm: they name a material point for ever, and the texture is written
in them.

All formulas are closed. The kernels here are called for every sub-pixel, so they take flat numbers; `sim.plate`,
`sim.panel` and `sim.steel` say where the numbers come from.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

FLAT: Final = 0
HEIGHT: Final = 1
PLATE: Final = 2
PANEL: Final = 3
SPHERE: Final = 4
_NO_TABLE: Final = np.zeros((4, 4))
_SPHERE_REACH_RAD: Final = 1.4  # beyond it a sphere is seen too flatly to be worth a texture


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A surface in one state of deformation, in the flat form that the kernels take.

    Parameters
    ----------
    kind
        ``FLAT``, ``HEIGHT``, ``PLATE``, ``PANEL`` or ``SPHERE``.
    parameters
        Numbers of that kind, see :func:`surface_point`.
    coarse, fine
        Coefficient tables of a height field.
    """

    kind: int
    parameters: Float
    coarse: Float = field(default_factory=_NO_TABLE.copy)
    fine: Float = field(default_factory=_NO_TABLE.copy)

    def place(self, st_mm: ArrayLike, branch: ArrayLike = 1.0) -> Float:
        """Places (..., 3) in the body's frame of material points (..., 2); ``branch`` +-1 picks a crack's lip."""
        st = np.asarray(st_mm, dtype=np.float64)
        side = np.broadcast_to(np.asarray(branch, dtype=np.float64), st.shape[:-1]).reshape(-1)
        out = np.empty((side.size, 9))
        _points(self.kind, self.parameters, self.coarse, self.fine, np.ascontiguousarray(st).reshape(-1, 2), side, out)
        return out[:, :3].reshape(*st.shape[:-1], 3)

    def tangents(self, st_mm: ArrayLike, branch: ArrayLike = 1.0) -> Float:
        """d(place) / d(s, t), (..., 3, 2), at material points (..., 2)."""
        st = np.asarray(st_mm, dtype=np.float64)
        side = np.broadcast_to(np.asarray(branch, dtype=np.float64), st.shape[:-1]).reshape(-1)
        out = np.empty((side.size, 9))
        _points(self.kind, self.parameters, self.coarse, self.fine, np.ascontiguousarray(st).reshape(-1, 2), side, out)
        return np.stack([out[:, 3:6], out[:, 6:9]], axis=-1).reshape(*st.shape[:-1], 3, 2)


def flat(in_plane: ArrayLike = ((1.0, 0.0), (0.0, 1.0))) -> Surface:
    """A plane, z = 0, whose material points lie at ``in_plane @ (s, t)``."""
    return Surface(kind=FLAT, parameters=np.asarray(in_plane, dtype=np.float64).reshape(4).copy())


def sphere(radius_mm: float) -> Surface:
    """A sphere whose pole touches z = 0 and bulges towards the cameras; (s, t) are arc lengths from the pole."""
    return Surface(kind=SPHERE, parameters=np.array([radius_mm]))


@njit(cache=True, nogil=True)
def surface_point(
    kind: int, par: Float, coarse: Float, fine: Float, s: float, t: float, branch: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Place and tangents (x, y, z, xs, ys, zs, xt, yt, zt) of a material point; NaN outside the surface."""
    if kind == FLAT:
        return (
            par[0] * s + par[1] * t, par[2] * s + par[3] * t, 0.0,
            par[0], par[2], 0.0, par[1], par[3], 0.0,
        )  # fmt: skip
    if kind == HEIGHT:
        z1, zs1, zt1 = _spline(coarse, s / par[1], t / par[2])
        z2, zs2, zt2 = _spline(fine, s / par[4], t / par[5])
        return (
            s, t, par[0] * z1 + par[3] * z2,
            1.0, 0.0, par[0] * zs1 / par[1] + par[3] * zs2 / par[4],
            0.0, 1.0, par[0] * zt1 / par[2] + par[3] * zt2 / par[5],
        )  # fmt: skip
    if kind == PLATE:
        return _plate_point(par, s, t)
    if kind == PANEL:
        return _panel_point(par, s, t, branch)
    return _sphere_point(par[0], s, t)


@njit(cache=True, nogil=True)
def _spline(table: Float, u: float, v: float) -> tuple[float, float, float]:
    """Uniform cubic B-spline surface with periodic coefficients: value and derivatives in u and v."""
    n_v, n_u = table.shape
    iu = int(np.floor(u))
    iv = int(np.floor(v))
    f = u - iu
    g = v - iv
    f1 = 1.0 - f
    g1 = 1.0 - g
    bu = (f1 * f1 * f1 / 6.0, (4.0 - 6.0 * f * f + 3.0 * f * f * f) / 6.0,
          (4.0 - 6.0 * f1 * f1 + 3.0 * f1 * f1 * f1) / 6.0, f * f * f / 6.0)  # fmt: skip
    du = (-0.5 * f1 * f1, -2.0 * f + 1.5 * f * f, 2.0 * f1 - 1.5 * f1 * f1, 0.5 * f * f)
    bv = (g1 * g1 * g1 / 6.0, (4.0 - 6.0 * g * g + 3.0 * g * g * g) / 6.0,
          (4.0 - 6.0 * g1 * g1 + 3.0 * g1 * g1 * g1) / 6.0, g * g * g / 6.0)  # fmt: skip
    dv = (-0.5 * g1 * g1, -2.0 * g + 1.5 * g * g, 2.0 * g1 - 1.5 * g1 * g1, 0.5 * g * g)
    z = 0.0
    zu = 0.0
    zv = 0.0
    for b in range(4):
        row = (iv + b) % n_v
        value = 0.0
        slope = 0.0
        for a in range(4):
            c = table[row, (iu + a) % n_u]
            value += bu[a] * c
            slope += du[a] * c
        z += bv[b] * value
        zu += bv[b] * slope
        zv += dv[b] * value
    return z, zu, zv


@njit(cache=True, nogil=True)
def _plate_point(
    par: Float, s: float, t: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Clamped circular plate: par = [a, w0, t/2, c1, c3, c5, c7]; see :mod:`sim.plate`."""
    a, w0, half = par[0], par[1], par[2]
    q = (s * s + t * t) / (a * a)
    if q >= 1.0:
        return s, t, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0
    e = 1.0 - q
    k = w0 / (a * a)
    # z = -w0 (1 - q)^2, towards the cameras
    z = -w0 * e * e
    zs = 4.0 * k * e * s
    zt = 4.0 * k * e * t
    # u = m(q) (s, t): the face leads the mid-plane by half the thickness times the slope, and the membrane follows
    scale = w0 * w0 / (a * a)
    m = half * 4.0 * k * e + scale * (par[3] + q * (par[4] + q * (par[5] + q * par[6])))
    dm = -half * 4.0 * k + scale * (par[4] + q * (2.0 * par[5] + q * 3.0 * par[6]))  # dm/dq
    qs = 2.0 * s / (a * a)
    qt = 2.0 * t / (a * a)
    return (
        s + m * s, t + m * t, z,
        1.0 + m + s * dm * qs, t * dm * qs, zs,
        s * dm * qt, 1.0 + m + t * dm * qt, zt,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _panel_point(
    par: Float, s: float, t: float, branch: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Centre-cracked panel: see :mod:`sim.panel` for the formulas and the meaning of ``par``."""
    a, stress, two_g, kappa = par[0], par[1], par[2], par[3]
    bow, bow_x, bow_y = par[4], par[5], par[6]
    buckle, lip, lx, ly, c0, peak = par[7], par[8], par[9], par[10], par[11], par[12]
    # crack field: root = sqrt(z^2 - a^2) with its cut along the crack, continued across it on the lip asked for
    zeta = complex(s, t)
    root = np.sqrt(zeta - a) * np.sqrt(zeta + a)
    if abs(s) < a and (t < 0.0) == (branch > 0.0):
        root = -root
    if abs(root) < 1e-9 * a:
        root = complex(1e-9 * a, 0.0)
    Zb = stress * root
    Z = stress * zeta / root
    dZ = -stress * a * a / (root * root * root)
    km, kp = 0.5 * (kappa - 1.0), 0.5 * (kappa + 1.0)
    ux, vy = 0.25 * (kappa + 1.0) * stress, 0.25 * (3.0 - kappa) * stress
    u = (km * Zb.real - t * Z.imag - ux * s) / two_g
    us = (km * Z.real - t * dZ.imag - ux) / two_g
    ut = (-kp * Z.imag - t * dZ.real) / two_g
    v = (kp * Zb.imag - t * Z.real + vy * t) / two_g
    vs = (kp * Z.imag - t * dZ.real) / two_g
    vt = (km * Z.real + t * dZ.imag + vy) / two_g
    # bow, straightening under load
    cs, ss = np.cos(np.pi * s / bow_x), np.sin(np.pi * s / bow_x)
    ct, st = np.cos(np.pi * t / bow_y), np.sin(np.pi * t / bow_y)
    z = bow * cs * ct
    zs = -bow * np.pi / bow_x * ss * ct
    zt = -bow * np.pi / bow_y * cs * st
    # buckles above and below the crack, and lips that part out of plane
    qx, qy = (s / lx) ** 2, (t / ly) ** 2
    gx, gy = np.exp(-qx), np.exp(-qy)
    g = (c0 + qy) * gy * gx / peak
    z += buckle * g
    zs += buckle * g * (-2.0 * s / (lx * lx))
    zt += buckle * gx * gy * (1.0 - c0 - qy) * 2.0 * t / (ly * ly) / peak
    h = root.imag / a
    dh = zeta / root / a
    z += lip * h * gx * gy
    zs += lip * gx * gy * (dh.imag - h * 2.0 * s / (lx * lx))
    zt += lip * gx * gy * (dh.real - h * 2.0 * t / (ly * ly))
    return s + u, t + v, z, 1.0 + us, vs, zs, ut, 1.0 + vt, zt


@njit(cache=True, nogil=True)
def _sphere_point(
    radius: float, s: float, t: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    rho2 = s * s + t * t
    rho = np.sqrt(rho2)
    theta = rho / radius
    if theta > _SPHERE_REACH_RAD:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    if theta < 1e-4:
        f = 1.0 - theta * theta / 6.0  # sin(theta) / theta
        df = -1.0 / (3.0 * radius * radius)  # (d f / d rho) / rho
    else:
        f = np.sin(theta) / theta
        df = (np.cos(theta) - f) / rho2
    return (
        f * s, f * t, radius * (1.0 - np.cos(theta)),
        f + df * s * s, df * s * t, f * s / radius,
        df * s * t, f + df * t * t, f * t / radius,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _points(kind: int, par: Float, coarse: Float, fine: Float, st: Float, branch: Float, out: Float) -> None:
    for k in range(st.shape[0]):
        values = surface_point(kind, par, coarse, fine, st[k, 0], st[k, 1], branch[k])
        for i in range(9):
            out[k, i] = values[i]
