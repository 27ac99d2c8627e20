"""The simulated cameras' own lens: OpenCV's pinhole with all fourteen coefficients of its distortion, there and back.

It shares nothing with `stereorig.core.cameras.lens` and the fit, so that images and truth of a simulated rig do not
inherit a fault of theirs:

    x_d = x N / D + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4,
    y_d = y N / D + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,
    N = 1 + k1 r^2 + k2 r^4 + k3 r^6,  D = 1 + k4 r^2 + k5 r^4 + k6 r^6,
    x_img = fx x_t / w_t + cx,  y_img = fy y_t / w_t + cy,  (x_t, y_t, w_t) = H (x_d, y_d, 1),

where H projects the plane of the distorted points onto a sensor that is turned by tau_x about its rows and then by
tau_y about its columns.

The way back is Newton's method, point by point, in `stereorig.sim.optics.ray`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import LensModel, MappedPoints, OpenCVLens, SeidelLens
from stereorig.core.cameras.opencv_full import opencv_lens_of
from stereorig.sim.optics.ray import BENT, RATIONAL, SEIDEL, scattered_rays

_BENT: Final = ("s1", "s2", "s3", "s4", "tau_x_rad", "tau_y_rad")
LENS_KEYS: Final = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", *_BENT)


@dataclass(frozen=True, kw_only=True)
class SimLens:
    """A lens of the simulated world.

    Attributes
    ----------
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point.
    k1, k2, p1, p2, k3, k4, k5, k6
        Distortion, in OpenCV's order.
    s1, s2, s3, s4
        Thin prism.
    tau_x_rad, tau_y_rad
        Tilt of the sensor.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    tau_x_rad: float = 0.0
    tau_y_rad: float = 0.0

    @cached_property
    def r2_max(self) -> float:
        """Largest r^2 up to which the image radius grows with r, infinite if it always does."""
        num = np.polynomial.Polynomial([1.0, self.k1, self.k2, self.k3])
        den = np.polynomial.Polynomial([1.0, self.k4, self.k5, self.k6])
        # d(r N/D)/dr D^2 = N D + 2 u (N' D - N D'), u = r^2
        u = np.polynomial.Polynomial([0.0, 2.0])
        growth = num * den + u * (num.deriv() * den - num * den.deriv())
        roots = np.concatenate([growth.trim().roots(), den.trim().roots()])
        real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))].real
        real = real[real > 0.0]
        return float(real.min()) if real.size else float("inf")

    @cached_property
    def on_sensor(self) -> Float:
        """Homography (3, 3) of the distorted points onto the sensor: identity if it is not tilted."""
        (sin_x, sin_y), (cos_x, cos_y) = (f([self.tau_x_rad, self.tau_y_rad]) for f in (np.sin, np.cos))
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_x, sin_x], [0.0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0.0, -sin_y], [0.0, 1.0, 0.0], [sin_y, 0.0, cos_y]])
        turn = about_y @ about_x
        # the ray through a distorted point meets the turned plane, whose own coordinates are those on the sensor
        meets = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
        return np.asarray(meets @ turn)

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        """Map normalised points (..., 2) to the image (..., 2)."""
        n = np.asarray(xy_norm, dtype=np.float64)
        valid = n[..., 0] ** 2 + n[..., 1] ** 2 < self.r2_max
        x, y = (np.where(valid, n[..., k], np.nan) for k in range(2))
        r2 = x * x + y * y
        radial = (1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / (
            1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        )
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x) + r2 * (self.s1 + r2 * self.s2)
        yd = y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y + r2 * (self.s3 + r2 * self.s4)
        xt, yt, wt = np.moveaxis(np.stack([xd, yd, np.ones_like(xd)], axis=-1) @ self.on_sensor.T, -1, 0)
        xd, yd = xt / wt, yt / wt
        return MappedPoints(np.stack([self.fx_px * xd + self.cx_px, self.fy_px * yd + self.cy_px], axis=-1), valid)

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        """Map pixels (..., 2) to normalised points (..., 2)."""
        return _rays_of(flat_lens(self), xy_px)


def lens_from_table(table: Mapping[str, Any]) -> SimLens:
    """Read ``fx_px`` ... ``tau_y_rad`` of a camera's table; KeyError or ValueError if one is missing or no number."""
    values = {}
    for name in LENS_KEYS:
        value = float(table[name] if name in LENS_KEYS[:4] else table.get(name, 0.0))
        if not np.isfinite(value):
            raise ValueError(f"{name} is {value}")
        values[name] = value
    if not (values["fx_px"] > 0.0 and values["fy_px"] > 0.0):
        raise ValueError(f"fx_px and fy_px must be positive, got {values['fx_px']:g} and {values['fy_px']:g}")
    return SimLens(**values)


def core_lens(lens: SimLens) -> OpenCVLens:
    """Return the lens as the core's class."""
    return opencv_lens_of({name: getattr(lens, name) for name in LENS_KEYS})


def flat_lens(lens: LensModel | SimLens) -> Float:
    """Flat (28,) form for `.optics.ray`.

    Kind, fx, fy, skew, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, largest r^2, s1 to s4, and the homography from a tilted
    sensor back to the distorted points. The paper's lens has ``kappa phd^2`` in place of k1. Only attributes are read,
    never the core's flat form.
    """
    out = np.zeros(28)
    if isinstance(lens, SeidelLens):
        fx, k = lens.phd_px, lens.kappa_per_px2 * lens.phd_px**2
        out[:7] = SEIDEL, fx, fx * lens.aspect, 0.0, lens.cx_px, lens.cy_px, k
        return out
    own = lens if isinstance(lens, SimLens) else _own(lens)
    bent = any(getattr(own, name) != 0.0 for name in _BENT)
    out[:6] = BENT if bent else RATIONAL, own.fx_px, own.fy_px, getattr(lens, "skew_px", 0.0), own.cx_px, own.cy_px
    out[6:14] = [getattr(own, name) for name in LENS_KEYS[4:12]]
    out[14] = own.r2_max
    out[15:19] = own.s1, own.s2, own.s3, own.s4
    out[19:] = np.linalg.inv(own.on_sensor).ravel()
    return out


def _own(lens: LensModel) -> SimLens:
    if not isinstance(lens, OpenCVLens):
        raise TypeError(f"the simulation has no rays of a {type(lens).__name__}")
    return SimLens(**{name: float(getattr(lens, name, 0.0)) for name in LENS_KEYS})


def normalised(lens: LensModel | SimLens, xy_px: ArrayLike) -> MappedPoints:
    """Map pixels (..., 2) to normalised points (..., 2) by the simulation's own inversion."""
    return lens.normalised_from_image(xy_px) if isinstance(lens, SeidelLens) else _rays_of(flat_lens(lens), xy_px)


def image_of(camera: Camera, points_sys_mm: ArrayLike) -> Float:
    """Return true images (..., 2) of points (..., 3) of the system frame, by the simulation's own formula."""
    p = camera.cam_from_sys.apply(points_sys_mm)
    lens = camera.lens
    skewed = isinstance(lens, OpenCVLens) and lens.skew_px != 0.0
    own = lens if isinstance(lens, SeidelLens) or skewed else _own(lens)
    n = p[..., :2] / np.where(p[..., 2] > 0.0, p[..., 2], np.nan)[..., None]
    return own.image_from_normalised(n).xy


def _rays_of(flat: Float, xy_px: ArrayLike) -> MappedPoints:
    xy = np.asarray(xy_px, dtype=np.float64)
    points = np.ascontiguousarray(xy.reshape(-1, 2))
    out = np.empty_like(points)
    scattered_rays(flat, points, out)
    out = out.reshape(xy.shape)
    return MappedPoints(out, np.asarray(np.isfinite(out).all(axis=-1)))


def warmed(lens: LensModel, shift_px: tuple[float, float], focal: float) -> LensModel:
    """Return the lens with its principal point shifted and its focal length larger by the share ``focal``."""
    if isinstance(lens, SeidelLens):
        longer = 1.0 + focal
        return SeidelLens(
            lens.phd_px * longer,
            lens.cx_px + shift_px[0],
            lens.cy_px + shift_px[1],
            lens.kappa_per_px2 / longer**2,
            lens.aspect,
        )
    if not isinstance(lens, OpenCVLens):
        raise TypeError(f"the simulation cannot warm a {type(lens).__name__}")
    values = {name: getattr(lens, name) for name in lens.parameter_names}
    values |= {
        "fx_px": lens.fx_px * (1.0 + focal),
        "fy_px": lens.fy_px * (1.0 + focal),
        "cx_px": lens.cx_px + shift_px[0],
        "cy_px": lens.cy_px + shift_px[1],
    }
    return type(lens)(**values)
