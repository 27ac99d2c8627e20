"""OpenCV's lens with all fourteen coefficients: also a thin prism (s1 to s4) and a tilted sensor (tau_x, tau_y).

A class of its own, so that the usual lenses compute nothing more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.cameras.lens import OpenCVLens

PRISM_TERMS = ("s1", "s2", "s3", "s4")
TILT_TERMS = ("tau_x_rad", "tau_y_rad")
_TINY = 1e-30  # an imaginary step: its quotient is the derivative, without a difference's rounding


@dataclass(frozen=True)
class OpenCVFullLens(OpenCVLens):
    """:class:`OpenCVLens` with ``s1 r^2 + s2 r^4`` added to x_d, ``s3 r^2 + s4 r^4`` to y_d, on a tilted sensor.

    The sensor is turned about its x axis by tau_x, then about its y axis by tau_y; rays through the principal point
    meet it there. Its points are a homography of the distorted ones.
    """

    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    tau_x_rad: float = 0.0
    tau_y_rad: float = 0.0

    parameter_names: ClassVar[tuple[str, ...]] = (*OpenCVLens.parameter_names, *PRISM_TERMS, *TILT_TERMS)

    @cached_property
    def tilt(self) -> Float:
        """Homography of the tilt, (5,): ``x = t0 x_d / w, y = (t1 x_d + t2 y_d) / w, w = 1 + t3 x_d + t4 y_d``."""
        return _tilt(self.tau_x_rad, self.tau_y_rad)

    @property
    def prism(self) -> dict[str, float]:
        """Thin prism and tilt by name."""
        return {name: getattr(self, name) for name in (*PRISM_TERMS, *TILT_TERMS)}

    def _shifted(self, x: Float, y: Float, r2: Float, radial: Float) -> tuple[Float, Float]:
        xd, yd = super()._shifted(x, y, r2, radial)
        return xd + r2 * (self.s1 + r2 * self.s2), yd + r2 * (self.s3 + r2 * self.s4)

    def _jacobian(self, x: Float, y: Float, r2: Float, radial: Float) -> tuple[Float, Float, Float, Float]:
        xx, xy, yx, yy = super()._jacobian(x, y, r2, radial)
        of_x, of_y = 2.0 * self.s1 + 4.0 * self.s2 * r2, 2.0 * self.s3 + 4.0 * self.s4 * r2
        return xx + of_x * x, xy + of_x * y, yx + of_y * x, yy + of_y * y

    def _image(self, d: Float) -> Float:
        return super()._image(_tilted(self.tilt, d))

    def _distorted_from_image(self, xy: Float) -> Float:
        t = self.tilt
        on_sensor = super()._distorted_from_image(xy)
        x = on_sensor[..., 0] / t[0]
        y = (on_sensor[..., 1] - t[1] * x) / t[2]
        left = 1.0 - t[3] * x - t[4] * y
        return np.stack([x, y], axis=-1) / np.where(left > 0.0, left, np.nan)[..., None]

    def _tilt_jacobian(self, d: Float) -> Float:
        t, on_sensor = self.tilt, _tilted(self.tilt, d)
        linear, w = np.array([[t[0], 0.0], [t[1], t[2]]]), 1.0 + t[3] * d[..., 0] + t[4] * d[..., 1]
        return np.asarray((linear - on_sensor[..., :, None] * t[3:]) / w[..., None, None])

    def image_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate the distortion, the tilt and the pixel map."""
        n = np.asarray(xy_norm, dtype=np.float64)
        return self._in_pixels(self._tilt_jacobian(self._distorted(n)) @ self._distorted_jacobian(n))

    def parameter_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate with respect to :attr:`parameter_names`."""
        n = np.asarray(xy_norm, dtype=np.float64)
        d, r2 = self._distorted(n), np.sum(n * n, axis=-1)
        first, zero = len(OpenCVLens.parameter_names), np.zeros_like(r2)
        shifts = [*self._by_terms(n), (first, r2, zero), (first + 1, r2 * r2, zero)]
        shifts += [(first + 2, zero, r2), (first + 3, zero, r2 * r2)]
        jac = self._tilt_jacobian(d)
        terms = [
            (k, *np.moveaxis((jac @ np.stack([dx, dy], axis=-1)[..., None])[..., 0], -1, 0)) for k, dx, dy in shifts
        ]
        for k, step in enumerate(((1j * _TINY, 0.0), (0.0, 1j * _TINY))):
            by_angle = _tilted(_tilt(self.tau_x_rad + step[0], self.tau_y_rad + step[1]), d).imag / _TINY
            terms.append((first + 4 + k, by_angle[..., 0], by_angle[..., 1]))
        return self._by_parameters(_tilted(self.tilt, d), terms)

    def kernel_parameters(self) -> Float:
        """Flat form (24,): the fifteen numbers of :class:`LensModel`, s1 to s4, and :attr:`tilt`."""
        return np.concatenate([super().kernel_parameters(), list(self.prism.values())[:4], self.tilt])


def opencv_lens_of(values: Mapping[str, float]) -> OpenCVLens:
    """Return the lens of parameters by name, zero for those not given; of the plain class if that is sufficient."""
    full = OpenCVFullLens(**values)
    if any(full.prism.values()):
        return full
    return OpenCVLens(**{k: v for k, v in values.items() if k in OpenCVLens.parameter_names})


def _tilt(tau_x: complex, tau_y: complex) -> Float:
    cos_x, cos_y, tan_x, tan_y = np.cos(tau_x), np.cos(tau_y), np.tan(tau_x), np.tan(tau_y)
    return np.array([1.0 / cos_y, -tan_x * tan_y, 1.0 / cos_x, tan_y / cos_x, -tan_x])


def _tilted(t: Float, d: Float) -> Float:
    x, y = d[..., 0], d[..., 1]
    on_sensor = np.stack([t[0] * x, t[1] * x + t[2] * y], axis=-1) / (1.0 + t[3] * x + t[4] * y)[..., None]
    return np.asarray(on_sensor)
