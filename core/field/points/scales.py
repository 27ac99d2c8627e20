"""Scales and checks of single points, compiled: they are needed of all points several times a step."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.matching.arguments import lens_of, own
from stereorig.core.matching.kernels.drivers import kernel_sources
from stereorig.core.matching.kernels.naming import entry, inner, stamp_of
from stereorig.core.matching.kernels.warp import image_of, lens_jacobian

MIN_COSINE = 0.1
"""Between a patch's normal and a camera's ray, below which the patch is too steep."""
MAX_SHEAR = 4.0
_STEP = 1e-6  # relative step of the inverse depth: its derivative from two positions, to six digits
_LEAST_PX = 1e-12


def depth_per_px(pair: StereoPair, rays: Float, w0: Float) -> Float:
    """Return |d w0| (n,) that moves camera 2's image by one pixel: the scale of every limit on depth.

    Parameters
    ----------
    pair
        The cameras.
    rays
        (n, 3) normalised, of camera 1.
    w0
        (n,) inverse depths on them, 1/mm.

    Returns
    -------
    Float
        (n,) 1/mm a px; NaN where camera 2's lens does not show the point.
    """
    out = np.empty(len(w0))
    pose = pair.cam2_from_cam1
    _depths_per_px(
        0, len(w0), lens_of(pair.cam2), own(pose.rotation), own(pose.translation_mm), own(rays), own(w0), out
    )
    return out


def px_per_ray(pair: StereoPair, rays: Float) -> Float:
    """Return (n, 3) px of camera 1's image a unit of its normalised rays: root of the area's, along x, along y.

    ``rays`` are as in :func:`depth_per_px`.
    """
    out = np.empty((len(rays), 3))
    _all_px_per_ray(0, len(rays), lens_of(pair.cam1), own(rays), out)
    return out


def far_from_start(
    pair: StereoPair, rays: Float, w: Float, G: Float, start_w: Float, start_G: Float | None, limit_px: float
) -> Bool:
    """Return (n,) True where a fit ended further than ``limit_px`` from its start in any image.

    Parameters
    ----------
    pair, rays
        As in :func:`depth_per_px`.
    w, G, start_w, start_G
        (n, 3 or 6), and (n, 3, 3 or 6) of a motion: see :mod:`stereorig.core.field.points.starts`. None of a shape.
    limit_px
        In camera 1's current image, and in camera 2's by the change of depth.
    """
    n, pose = len(w), pair.cam2_from_cam1
    motion = start_G is not None
    g, start_g = (_flat(G if one is None else one) for one in (G, start_G))
    out = np.empty(n, np.bool_)
    cameras = lens_of(pair.cam1), lens_of(pair.cam2), own(pose.rotation), own(pose.translation_mm)
    _all_far_from_start(0, n, cameras, own(rays), own(w), g, own(start_w), start_g, motion, float(limit_px), out)
    return out


def plausible(pair: StereoPair, rays: Float, w: Float, G: Float | None) -> Bool:
    """Return (n,) True for fits that can be a patch of a surface.

    Its front faces both cameras; currently it is in front of camera 1, not mirrored, and not stretched too far.

    Parameters
    ----------
    pair, rays
        As in :func:`depth_per_px`.
    w, G
        As in :func:`far_from_start`; ``G`` None for a shape.
    """
    n, motion = len(w), G is not None
    g = np.zeros((n, 3 * w.shape[1])) if G is None else _flat(G)
    out = np.empty(n, np.bool_)
    _all_plausible(0, n, own(pair.cam2_from_cam1.inverse().translation_mm), own(rays), own(w), g, motion, out)
    return out


def _flat(G: Float) -> Float:
    """(n, 9 or 18) of G (n, 3, 3 or 6), also of no points."""
    return own(G).reshape(len(G), 3 * G.shape[2])


@inner
def _seen_by_camera2(lens, R, t, x, y, w0):
    """Pixel of camera 2 of the point on a ray (x, y, 1) at an inverse depth; NaN outside the lens's domain."""
    a, b, c = x / w0, y / w0, 1.0 / w0
    p0 = a * R[0, 0] + b * R[0, 1] + c * R[0, 2] + t[0]
    p1 = a * R[1, 0] + b * R[1, 1] + c * R[1, 2] + t[1]
    p2 = a * R[2, 0] + b * R[2, 1] + c * R[2, 2] + t[2]
    u, v = p0 / p2, p1 / p2
    if not u * u + v * v < lens[11]:
        return np.nan, np.nan
    px, py, _, _, _, _ = image_of(lens, u, v)
    return px, py


@inner
def _depth_of_a_px(lens, R, t, x, y, w0):
    step = _STEP * abs(w0)
    x0, y0 = _seen_by_camera2(lens, R, t, x, y, w0)
    x1, y1 = _seen_by_camera2(lens, R, t, x, y, w0 + step)
    shift = math.sqrt((x0 - x1) * (x0 - x1) + (y0 - y1) * (y0 - y1))
    return step / (_LEAST_PX if shift < _LEAST_PX else shift)


@inner
def _root_of_area(j11, j12, j21, j22):
    return math.sqrt(abs(j11 * j22 - j12 * j21))


@inner
def is_plausible(centre2, x, y, w, g, motion):
    """Return True if one fit can be a patch of a surface; see :func:`plausible`.

    ``centre2`` (3,) mm is camera 2 in camera 1's frame, ``w`` (3 or 6,), ``g`` three times as many, row by row.
    """
    w0, w1, w2 = w[0], w[1], w[2]
    n0, n1, n2 = w1, w2, w0 - w1 * x - w2 * y
    length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    p0, p1, p2 = x / w0, y / w0, 1.0 / w0
    q0, q1, q2 = p0 - centre2[0], p1 - centre2[1], p2 - centre2[2]
    cosine1 = (n0 * p0 + n1 * p1 + n2 * p2) / (length * math.sqrt(p0 * p0 + p1 * p1 + p2 * p2))
    cosine2 = (n0 * q0 + n1 * q1 + n2 * q2) / (length * math.sqrt(q0 * q0 + q1 * q1 + q2 * q2))
    if not (w0 > 0.0 and cosine1 > MIN_COSINE and cosine2 > MIN_COSINE):
        return False
    if not motion:
        return True
    # camera 1's current image over its reference image, normalised
    k = w.shape[0]
    x1, y1, z = g[0], g[k], g[2 * k]
    a00, a01 = (g[1] - x1 * g[2 * k + 1] / z) / z, (g[2] - x1 * g[2 * k + 2] / z) / z
    a10, a11 = (g[k + 1] - y1 * g[2 * k + 1] / z) / z, (g[k + 2] - y1 * g[2 * k + 2] / z) / z
    det = a00 * a11 - a01 * a10
    square = 0.5 * (a00 * a00 + a01 * a01 + a10 * a10 + a11 * a11)
    return z / w0 > 0.0 and det > 0.0 and square < MAX_SHEAR * MAX_SHEAR and det > square / MAX_SHEAR


def _entries(stamp):
    @entry
    def depths_per_px(first, last, lens, R, t, rays, w0, out):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        for i in range(first, last):
            out[i] = _depth_of_a_px(lens, R, t, rays[i, 0], rays[i, 1], w0[i])

    @entry
    def all_px_per_ray(first, last, lens, rays, out):
        if stamp < 0:
            return
        for i in range(first, last):
            j11, j12, j21, j22 = lens_jacobian(lens, rays[i, 0], rays[i, 1])
            out[i, 0] = _root_of_area(j11, j12, j21, j22)
            out[i, 1], out[i, 2] = math.sqrt(j11 * j11 + j21 * j21), math.sqrt(j12 * j12 + j22 * j22)

    @entry
    def all_far_from_start(first, last, cameras, rays, w, g, start_w, start_g, motion, limit_px, out):
        if stamp < 0:
            return
        lens1, lens2, R, t = cameras
        terms, start_terms = g.shape[1] // 3, start_g.shape[1] // 3
        for i in range(first, last):
            x, y, w0 = rays[i, 0], rays[i, 1], start_w[i, 0]
            near = abs(w[i, 0] - w0) / _depth_of_a_px(lens2, R, t, x, y, w0) < limit_px
            if motion and near:
                j11, j12, j21, j22 = lens_jacobian(lens1, x, y)
                now, before = g[i], start_g[i]
                across = now[0] / now[2 * terms] - before[0] / before[2 * start_terms]
                down = now[terms] / now[2 * terms] - before[start_terms] / before[2 * start_terms]
                near = math.sqrt(across * across + down * down) * _root_of_area(j11, j12, j21, j22) < limit_px
            out[i] = not near

    @entry
    def all_plausible(first, last, centre2, rays, w, g, motion, out):
        if stamp < 0:
            return
        for i in range(first, last):
            out[i] = is_plausible(centre2, rays[i, 0], rays[i, 1], w[i], g[i], motion)

    return depths_per_px, all_px_per_ray, all_far_from_start, all_plausible


SOURCES = (*kernel_sources(), Path(__file__))
"""Files that these kernels are made of."""
_depths_per_px, _all_px_per_ray, _all_far_from_start, _all_plausible = _entries(stamp_of(SOURCES))
