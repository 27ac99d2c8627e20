"""The simulated cameras' own lens: OpenCV's pinhole with rational and tangential distortion, there and back.

It shares nothing with `stereorig.core.cameras.lens` and the fit, so that images and truth of a simulated rig do not
inherit a fault of theirs:

    x_d = x N / D + 2 p1 x y + p2 (r^2 + 2 x^2),  y_d = y N / D + p1 (r^2 + 2 y^2) + 2 p2 x y,
    N = 1 + k1 r^2 + k2 r^4 + k3 r^6,  D = 1 + k4 r^2 + k5 r^4 + k6 r^6,
    x_img = fx x_d + cx,  y_img = fy y_d + cy.

The way back is Newton's method, point by point, in `stereorig.sim.optics.ray`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import LensModel, MappedPoints, OpenCVLens, SeidelLens
from stereorig.sim.optics.ray import RATIONAL, SEIDEL, scattered_rays

LENS_KEYS: Final = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, kw_only=True)
class SimLens:
    """A lens of the simulated world; it has the interface of `stereorig.core.cameras.lens.LensModel`.

    Attributes
    ----------
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point.
    k1, k2, p1, p2, k3, k4, k5, k6
        Distortion, in OpenCV's order.
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

    parameter_names: ClassVar[tuple[str, ...]] = LENS_KEYS

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

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        """Map normalised points (..., 2) to the image (..., 2)."""
        n = np.asarray(xy_norm, dtype=np.float64)
        valid = n[..., 0] ** 2 + n[..., 1] ** 2 < self.r2_max
        x, y = (np.where(valid, n[..., k], np.nan) for k in range(2))
        r2 = x * x + y * y
        radial = (1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / (
            1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        )
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        yd = y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return MappedPoints(np.stack([self.fx_px * xd + self.cx_px, self.fy_px * yd + self.cy_px], axis=-1), valid)

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        """Map pixels (..., 2) to normalised points (..., 2)."""
        return _rays_of(flat_lens(self), xy_px)

    def image_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Return d(image px) / d(normalised), (..., 2, 2), at normalised points (..., 2)."""
        n = np.asarray(xy_norm, dtype=np.float64)
        x, y = n[..., 0], n[..., 1]
        u = x * x + y * y
        num, den = 1.0 + u * (self.k1 + u * (self.k2 + u * self.k3)), 1.0 + u * (self.k4 + u * (self.k5 + u * self.k6))
        num_slope = self.k1 + u * (2.0 * self.k2 + 3.0 * u * self.k3)
        den_slope = self.k4 + u * (2.0 * self.k5 + 3.0 * u * self.k6)
        radial, slope = num / den, 2.0 * (num_slope * den - num * den_slope) / den**2
        jac = np.empty((*n.shape[:-1], 2, 2))
        jac[..., 0, 0] = self.fx_px * (radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x)
        jac[..., 0, 1] = self.fx_px * (x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y)
        jac[..., 1, 0] = self.fy_px * (x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y)
        jac[..., 1, 1] = self.fy_px * (radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x)
        return jac

    def parameter_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Return d(image px) / d(parameters), (..., 2, 12), by central differences."""
        columns = []
        for name in LENS_KEYS:
            value = float(getattr(self, name))
            h = 1e-6 * max(1.0, abs(value))
            above, below = (self.changed(**{name: value + sign * h}) for sign in (1.0, -1.0))
            difference = above.image_from_normalised(xy_norm).xy - below.image_from_normalised(xy_norm).xy
            columns.append(difference / (2.0 * h))
        return np.stack(columns, axis=-1)

    def changed(self, **values: float) -> SimLens:
        """Return the lens with other values."""
        return SimLens(**({name: getattr(self, name) for name in LENS_KEYS} | values))

    def kernel_parameters(self) -> Float:
        """Flat form of the simulation's own kernels, see :func:`flat_lens`."""
        return flat_lens(self)


def lens_from_table(table: Mapping[str, Any]) -> SimLens:
    """Read ``fx_px`` ... ``k6`` of a camera's table; KeyError or ValueError if one is missing or no number."""
    values = {}
    for name in LENS_KEYS:
        value = float(table[name] if name in LENS_KEYS[:4] else table.get(name, 0.0))
        if not np.isfinite(value):
            raise ValueError(f"{name} is {value}")
        values[name] = value
    if not (values["fx_px"] > 0.0 and values["fy_px"] > 0.0):
        raise ValueError(f"fx_px and fy_px must be positive, got {values['fx_px']:g} and {values['fy_px']:g}")
    return SimLens(**values)


def core_lens(lens: SimLens) -> LensModel:
    """Return the lens as the core's class, if that holds all its terms; else itself."""
    known = {field.name for field in fields(OpenCVLens)}
    values = {name: getattr(lens, name) for name in LENS_KEYS}
    if any(value != 0.0 and name not in known for name, value in values.items()):
        return lens
    return OpenCVLens(**{name: value for name, value in values.items() if name in known})


def flat_lens(lens: LensModel) -> Float:
    """Flat (16,) form for `.optics.ray`: kind, fx, fy, skew, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, largest r^2, 0.

    The paper's lens has ``kappa phd^2`` in place of k1. Only attributes are read, never the core's flat form.
    """
    out = np.zeros(16)
    if isinstance(lens, SeidelLens):
        fx, k = lens.phd_px, lens.kappa_per_px2 * lens.phd_px**2
        out[:7] = SEIDEL, fx, fx * lens.aspect, 0.0, lens.cx_px, lens.cy_px, k
        return out
    own = lens if isinstance(lens, SimLens) else _own(lens)
    out[:6] = RATIONAL, own.fx_px, own.fy_px, getattr(lens, "skew_px", 0.0), own.cx_px, own.cy_px
    out[6:14] = [getattr(own, name) for name in LENS_KEYS[4:]]
    out[14] = own.r2_max
    return out


def _own(lens: LensModel) -> SimLens:
    if not isinstance(lens, OpenCVLens):
        raise TypeError(f"the simulation has no rays of a {type(lens).__name__}")
    unknown = {name: getattr(lens, name) for name in lens.parameter_names if name not in (*LENS_KEYS, "skew_px")}
    if any(value != 0.0 for value in unknown.values()):
        raise TypeError(f"the simulation has no rays of a lens with {', '.join(unknown)}")
    return SimLens(**{name: float(getattr(lens, name, 0.0)) for name in LENS_KEYS})


def normalised(lens: LensModel, xy_px: ArrayLike) -> MappedPoints:
    """Map pixels (..., 2) to normalised points (..., 2) by the simulation's own inversion."""
    return lens.normalised_from_image(xy_px) if isinstance(lens, SeidelLens) else _rays_of(flat_lens(lens), xy_px)


def image_of(camera: Camera, points_sys_mm: ArrayLike) -> Float:
    """Return true images (..., 2) of points (..., 3) of the system frame, by the simulation's own formula."""
    p = camera.cam_from_sys.apply(points_sys_mm)
    lens = camera.lens
    skewed = isinstance(lens, OpenCVLens) and lens.skew_px != 0.0
    own = lens if isinstance(lens, SeidelLens | SimLens) or skewed else _own(lens)
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
    if not isinstance(lens, OpenCVLens | SimLens):
        raise TypeError(f"the simulation cannot warm a {type(lens).__name__}")
    values = {name: getattr(lens, name) for name in lens.parameter_names}
    values |= {
        "fx_px": lens.fx_px * (1.0 + focal),
        "fy_px": lens.fy_px * (1.0 + focal),
        "cx_px": lens.cx_px + shift_px[0],
        "cy_px": lens.cy_px + shift_px[1],
    }
    return type(lens)(**values)
