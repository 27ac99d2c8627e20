"""Compiled formulas of the surfaces, over arrays of material points; see `stereorig.sim.surface`.

Every surface kernel writes ``out`` (9, n): position x, y, z and tangents xs, ys, zs, xt, yt, zt of the points (s, t).
They are plain loops without calls that pass arrays on: such calls take ten times as long as the formulas.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from stereorig.core.arrays import Bool, Float

_SPHERE_REACH_RAD: Final = 1.4  # beyond it a sphere is seen too obliquely for a texture


@njit(cache=True, nogil=True, error_model="numpy")
def meet_plane(par: Float, pose: Float, nx: Float, ny: Float, s: Float, t: Float) -> None:
    """Meet rays with a plane, ``par`` = [a11, a12, a21, a22]: linear equations in (s, t). NaN behind the camera."""
    for i in range(nx.size):
        ax, ay = pose[0, 0] - nx[i] * pose[2, 0], pose[0, 1] - nx[i] * pose[2, 1]
        bx, by = pose[1, 0] - ny[i] * pose[2, 0], pose[1, 1] - ny[i] * pose[2, 1]
        f, g = pose[0, 3] - nx[i] * pose[2, 3], pose[1, 3] - ny[i] * pose[2, 3]
        d = -1.0 / (ax * by - ay * bx)
        x, y = d * (by * f - ay * g), d * (ax * g - bx * f)
        behind = pose[2, 0] * x + pose[2, 1] * y + pose[2, 3] <= 0.0
        d = np.nan if behind else 1.0 / (par[0] * par[3] - par[1] * par[2])
        s[i] = d * (par[3] * x - par[1] * y)
        t[i] = d * (par[0] * y - par[2] * x)


@njit(cache=True, nogil=True, error_model="numpy")
def meet_bowl(par: Float, pose: Float, nx: Float, ny: Float, s: Float, t: Float) -> None:
    """Meet rays with the paraboloid z = c (x^2 + y^2), ``par`` = [c]; of two points the one next to the plane z = 0.

    The ray in the body's frame is o + m d: a quadratic equation in m, solved in the form that does not cancel.
    """
    c = par[0]
    ox = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])
    oy = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    oz = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    for i in range(nx.size):
        dx = pose[0, 0] * nx[i] + pose[1, 0] * ny[i] + pose[2, 0]
        dy = pose[0, 1] * nx[i] + pose[1, 1] * ny[i] + pose[2, 1]
        dz = pose[0, 2] * nx[i] + pose[1, 2] * ny[i] + pose[2, 2]
        m0 = -oz / dz  # to the plane; the bowl is a little off it
        x0, y0 = ox + m0 * dx, oy + m0 * dy
        f = c * (x0 * x0 + y0 * y0)
        g = 2.0 * c * (x0 * dx + y0 * dy) - dz
        h = c * (dx * dx + dy * dy)
        q = g * g - 4.0 * h * f
        m = m0 - 2.0 * f / (g + np.copysign(np.sqrt(q), g)) if q >= 0.0 else np.nan
        if not m > 0.0:
            m = np.nan
        s[i] = ox + m * dx
        t[i] = oy + m * dy


@njit(cache=True, nogil=True, error_model="numpy")
def bowl(par: Float, s: Float, t: Float, out: Float) -> None:
    """The paraboloid z = c (x^2 + y^2), ``par`` = [c], over x = s, y = t."""
    for i in range(s.size):
        out[0, i], out[1, i], out[2, i] = s[i], t[i], par[0] * (s[i] * s[i] + t[i] * t[i])
        out[3, i], out[4, i], out[5, i] = 1.0, 0.0, 2.0 * par[0] * s[i]
        out[6, i], out[7, i], out[8, i] = 0.0, 1.0, 2.0 * par[0] * t[i]


@njit(cache=True, nogil=True, error_model="numpy")
def newton_step(pose: Float, nx: Float, ny: Float, at: Float, s: Float, t: Float, step: Float) -> float:
    """Move (s, t) by one Newton step from the positions and tangents ``at``; return the longest, NaN excluded.

    A point behind the camera becomes NaN.
    """
    longest = 0.0
    for i in range(s.size):
        px, py, pz = pose[0, 0] - nx[i] * pose[2, 0], pose[0, 1] - nx[i] * pose[2, 1], pose[0, 2] - nx[i] * pose[2, 2]
        qx, qy, qz = pose[1, 0] - ny[i] * pose[2, 0], pose[1, 1] - ny[i] * pose[2, 1], pose[1, 2] - ny[i] * pose[2, 2]
        f = px * at[0, i] + py * at[1, i] + pz * at[2, i] + pose[0, 3] - nx[i] * pose[2, 3]
        g = qx * at[0, i] + qy * at[1, i] + qz * at[2, i] + pose[1, 3] - ny[i] * pose[2, 3]
        fs = px * at[3, i] + py * at[4, i] + pz * at[5, i]
        gs = qx * at[3, i] + qy * at[4, i] + qz * at[5, i]
        ft = px * at[6, i] + py * at[7, i] + pz * at[8, i]
        gt = qx * at[6, i] + qy * at[7, i] + qz * at[8, i]
        d = 1.0 / (fs * gt - ft * gs)
        ahead = pose[2, 0] * at[0, i] + pose[2, 1] * at[1, i] + pose[2, 2] * at[2, i] + pose[2, 3] > 0.0
        ds = d * (gt * f - ft * g) if ahead else np.nan
        dt = d * (fs * g - gs * f) if ahead else np.nan
        s[i] -= ds
        t[i] -= dt
        step[i] = abs(ds) + abs(dt)
        longest = step[i] if step[i] > longest else longest
    return longest


@njit(cache=True, nogil=True, error_model="numpy")
def plane(par: Float, s: Float, t: Float, out: Float) -> None:
    """A plane with in-plane deformation ``par`` = [a11, a12, a21, a22]."""
    for i in range(s.size):
        out[0, i] = par[0] * s[i] + par[1] * t[i]
        out[1, i] = par[2] * s[i] + par[3] * t[i]
        out[2, i] = 0.0
        out[3, i], out[4, i], out[5, i] = par[0], par[2], 0.0
        out[6, i], out[7, i], out[8, i] = par[1], par[3], 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def height_field(par: Float, coarse: Float, fine: Float, s: Float, t: Float, out: Float) -> None:
    """Sum of two uniform cubic B-spline surfaces, each ``par`` = [amplitude, spacing s, spacing t].

    The tables repeat; their sides are powers of two.
    """
    for i in range(s.size):
        out[0, i], out[1, i], out[2, i] = s[i], t[i], 0.0
        out[3, i], out[4, i], out[5, i] = 1.0, 0.0, 0.0
        out[6, i], out[7, i], out[8, i] = 0.0, 1.0, 0.0
    for layer in range(2):
        table = coarse if layer == 0 else fine
        mask_v, mask_u = table.shape[0] - 1, table.shape[1] - 1
        high, scale_u, scale_v = par[3 * layer], 1.0 / par[3 * layer + 1], 1.0 / par[3 * layer + 2]
        for i in range(s.size):
            if not (abs(s[i]) < 1e6 and abs(t[i]) < 1e6):
                out[2, i] = np.nan
                continue
            u, v = s[i] * scale_u, t[i] * scale_v
            iu, iv = int(np.floor(u)), int(np.floor(v))
            f, g = u - iu, v - iv
            e, h = 1.0 - f, 1.0 - g
            b0, b3 = e * e * e / 6.0, f * f * f / 6.0
            b1 = (4.0 - 6.0 * f * f + 3.0 * f * f * f) / 6.0
            b2 = (4.0 - 6.0 * e * e + 3.0 * e * e * e) / 6.0
            d0, d1, d2, d3 = -0.5 * e * e, -2.0 * f + 1.5 * f * f, 2.0 * e - 1.5 * e * e, 0.5 * f * f
            c0, c3 = h * h * h / 6.0, g * g * g / 6.0
            c1 = (4.0 - 6.0 * g * g + 3.0 * g * g * g) / 6.0
            c2 = (4.0 - 6.0 * h * h + 3.0 * h * h * h) / 6.0
            k0, k1, k2, k3 = -0.5 * h * h, -2.0 * g + 1.5 * g * g, 2.0 * h - 1.5 * h * h, 0.5 * g * g
            i0, i1, i2, i3 = iu & mask_u, (iu + 1) & mask_u, (iu + 2) & mask_u, (iu + 3) & mask_u
            z, zu, zv = 0.0, 0.0, 0.0
            for row in range(4):
                r = (iv + row) & mask_v
                value = b0 * table[r, i0] + b1 * table[r, i1] + b2 * table[r, i2] + b3 * table[r, i3]
                slope = d0 * table[r, i0] + d1 * table[r, i1] + d2 * table[r, i2] + d3 * table[r, i3]
                c = c0 if row == 0 else (c1 if row == 1 else (c2 if row == 2 else c3))
                k = k0 if row == 0 else (k1 if row == 1 else (k2 if row == 2 else k3))
                z += c * value
                zu += c * slope
                zv += k * value
            out[2, i] += high * z
            out[5, i] += high * scale_u * zu
            out[8, i] += high * scale_v * zv


@njit(cache=True, nogil=True, error_model="numpy")
def circular_plate(par: Float, s: Float, t: Float, out: Float) -> None:
    """Clamped circular plate, ``par`` = [a, w0, t/2, c1, c3, c5, c7]; see `stereorig.sim.plate`."""
    w0, half = par[1], par[2]
    inverse = 1.0 / (par[0] * par[0])
    k = w0 * inverse
    scale = w0 * w0 * inverse
    for i in range(s.size):
        x, y = s[i], t[i]
        q = (x * x + y * y) * inverse
        e = max(1.0 - q, 0.0)
        inside = 1.0 if q < 1.0 else 0.0
        # u = m(q) (s, t): the face leads the mid-plane by half the thickness times the slope, and the membrane follows
        m = 4.0 * half * k * e + inside * scale * (par[3] + q * (par[4] + q * (par[5] + q * par[6])))
        dm = inside * (scale * (par[4] + q * (2.0 * par[5] + q * 3.0 * par[6])) - 4.0 * half * k)  # dm/dq
        dm2 = 2.0 * inverse * dm
        out[0, i], out[1, i], out[2, i] = x + m * x, y + m * y, -w0 * e * e  # towards the cameras
        out[3, i], out[4, i], out[5, i] = 1.0 + m + dm2 * x * x, dm2 * x * y, 4.0 * k * e * x
        out[6, i], out[7, i], out[8, i] = dm2 * x * y, 1.0 + m + dm2 * y * y, 4.0 * k * e * y


@njit(cache=True, nogil=True, error_model="numpy")
def cracked_panel(par: Float, s: Float, t: Float, lip: Float, out: Float) -> None:
    """Centre-cracked panel; see `stereorig.sim.panel` for the formulas.

    ``par`` = [a, S, 2G, kappa, bow, Lx, Ly, A, lip, lx, ly, c0, peak].
    """
    a, stress, two_g, kappa = par[0], par[1], par[2], par[3]
    bow, wave_x, wave_y = par[4], np.pi / par[5], np.pi / par[6]
    buckle, part, lx2, ly2, c0, peak = par[7], par[8], par[9] ** 2, par[10] ** 2, par[11], par[12]
    km, kp = 0.5 * (kappa - 1.0), 0.5 * (kappa + 1.0)
    ux, vy = 0.25 * (kappa + 1.0) * stress, 0.25 * (3.0 - kappa) * stress
    for i in range(s.size):
        x, y = s[i], t[i]
        # root = sqrt(z^2 - a^2) with its cut along the crack, continued across it on the lip given
        zeta = complex(x, y + 0.0)  # no negative zero, whose root is on the other lip
        root = np.sqrt(zeta - a) * np.sqrt(zeta + a)
        if abs(x) < a and (y < 0.0) == (lip[i] > 0.0):
            root = -root
        if abs(root.real) + abs(root.imag) < 1e-9 * a:
            root = complex(1e-9 * a, 0.0)  # the crack's tip itself
        over = 1.0 / root
        F = stress * root
        dF = stress * zeta * over
        ddF = -stress * a * a * over * over * over
        u = (km * F.real - y * dF.imag - ux * x) / two_g
        us = (km * dF.real - y * ddF.imag - ux) / two_g
        ut = (-kp * dF.imag - y * ddF.real) / two_g
        v = (kp * F.imag - y * dF.real + vy * y) / two_g
        vs = (kp * dF.imag - y * ddF.real) / two_g
        vt = (km * dF.real + y * ddF.imag + vy) / two_g
        # the bow
        cs, ss = np.cos(wave_x * x), np.sin(wave_x * x)
        ct, st = np.cos(wave_y * y), np.sin(wave_y * y)
        z, zs, zt = bow * cs * ct, -bow * wave_x * ss * ct, -bow * wave_y * cs * st
        # crests above and below the crack, and lips that separate out of plane
        qy = y * y / ly2
        bell = np.exp(-x * x / lx2 - qy)
        crest = buckle / peak * bell
        z += crest * (c0 + qy)
        zs -= crest * (c0 + qy) * 2.0 * x / lx2
        zt += crest * (1.0 - c0 - qy) * 2.0 * y / ly2
        h = root.imag / a
        dh = zeta * over / a
        z += part * bell * h
        zs += part * bell * (dh.imag - h * 2.0 * x / lx2)
        zt += part * bell * (dh.real - h * 2.0 * y / ly2)
        out[0, i], out[1, i], out[2, i] = x + u, y + v, z
        out[3, i], out[4, i], out[5, i] = 1.0 + us, vs, zs
        out[6, i], out[7, i], out[8, i] = ut, 1.0 + vt, zt


@njit(cache=True, nogil=True, error_model="numpy")
def sphere(par: Float, s: Float, t: Float, out: Float) -> None:
    """Sphere of radius ``par[0]`` with its pole at the origin; NaN far from the pole."""
    radius = par[0]
    for i in range(s.size):
        x, y = s[i], t[i]
        rho2 = x * x + y * y
        theta = np.sqrt(rho2) / radius
        if theta < 1e-4:
            f = 1.0 - theta * theta / 6.0  # sin(theta) / theta
            df = -1.0 / (3.0 * radius * radius)  # (df / drho) / rho
        else:
            f = np.sin(theta) / theta
            df = (np.cos(theta) - f) / rho2
        seen = theta <= _SPHERE_REACH_RAD
        out[0, i], out[1, i] = f * x, f * y
        out[2, i] = radius * (1.0 - np.cos(theta)) if seen else np.nan
        out[3, i], out[4, i], out[5, i] = f + df * x * x, df * x * y, f * x / radius
        out[6, i], out[7, i], out[8, i] = df * x * y, f + df * y * y, f * y / radius


@njit(cache=True, nogil=True, error_model="numpy")
def _outside_unit_circle(radius: float, m: float, s: float, t: float) -> complex:
    """Return zeta of z = R (zeta + m / zeta), the root that is not less than sqrt(m)."""
    z = complex(s, t) / radius
    edge = 2.0 * np.sqrt(m)
    zeta: complex = 0.5 * (z + np.sqrt(z - edge) * np.sqrt(z + edge))
    return zeta


@njit(cache=True, nogil=True, error_model="numpy")
def inside_notch(par: Float, s: Float, t: Float) -> Bool:
    """True where a material point lies in the notch, ``par`` as for :func:`notched_sheet`."""
    out = np.empty(s.size, np.bool_)
    for i in range(s.size):
        out[i] = abs(_outside_unit_circle(par[0], par[1], s[i], t[i])) < 1.0
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def notched_sheet(par: Float, s: Float, t: Float, out: Float) -> None:
    """The sheet with an elliptical notch in tension along t, ``par`` = [R, m, S / (2 G), kappa]; `stereorig.sim.notch`.

    Within the notch, next to its edge, the potentials are continued, so that a ray's search may cross it.
    """
    radius, m, load, kappa = par[0], par[1], par[2], par[3]
    q = 1.0 + m + m * m
    for i in range(s.size):
        zeta = _outside_unit_circle(radius, m, s[i], t[i])
        if not abs(zeta) > 0.9:
            for k in range(9):
                out[k, i] = np.nan
            continue
        z = complex(s[i], t[i])
        one = 1.0 / zeta
        by_zeta = radius * (1.0 - m * one * one)  # dz / d zeta
        phi = 0.25 * radius * load * (zeta - (2.0 + m) * one)
        slope = 0.25 * radius * load * (1.0 + (2.0 + m) * one * one)
        phi1 = slope / by_zeta
        bent = -0.5 * radius * load * (2.0 + m) * one * one * one
        phi2 = (bent * by_zeta - slope * 2.0 * radius * m * one * one * one) / (by_zeta * by_zeta * by_zeta)
        above, below = q * zeta * zeta + 1.0, zeta * (zeta * zeta - m)
        psi = 0.5 * radius * load * (zeta - above / below)
        turned = (2.0 * q * zeta * below - above * (3.0 * zeta * zeta - m)) / (below * below)
        psi1 = 0.5 * radius * load * (1.0 - turned) / by_zeta
        moved = kappa * phi - z * np.conj(phi1) - np.conj(psi)
        far = z * np.conj(phi2) + np.conj(psi1)
        by_s = kappa * phi1 - np.conj(phi1) - far
        by_t = 1j * (kappa * phi1 - np.conj(phi1) + far)
        out[0, i], out[1, i], out[2, i] = s[i] + moved.real, t[i] + moved.imag, 0.0
        out[3, i], out[4, i], out[5, i] = 1.0 + by_s.real, by_s.imag, 0.0
        out[6, i], out[7, i], out[8, i] = by_t.real, 1.0 + by_t.imag, 0.0
