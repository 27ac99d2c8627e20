"""Lens models: from normalised camera coordinates to the image and back.

A lens model maps the normalised point ``(X_cam / Z_cam, Y_cam / Z_cam)`` to image pixels. Two models share one small
interface: the paper's Seidel term, Eqs. (5) to (8), and OpenCV's ``k1 k2 p1 p2 k3 k4 k5 k6``.

Conventions: pixel centres at integers, x = column to the right, y = row down. A point outside a model's domain is
marked in ``valid``; its coordinates are then NaN and must not be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float

SEIDEL = 0.0
OPENCV = 1.0
N_KERNEL_PARAMETERS = 15
_NEWTON_STEPS = 30
#: number of coordinates of an array from which on its inversion is cached separately from smaller ones, and above which
#: it is not cached
_FEW, _MANY = 500, 100_000
_BISECTIONS = 30  # to 1e-9 of the branch; Newton's method does the rest


class MappedPoints(NamedTuple):
    """Points after a mapping with a limited domain.

    Attributes
    ----------
    xy
        (..., 2) coordinates; NaN where ``valid`` is False.
    valid
        (...) bool, False where the point has no image (or no ray).
    """

    xy: Float
    valid: Bool


@runtime_checkable
class LensModel(Protocol):
    """Interface of the lens models.

    >>> lens = SeidelLens(phd_px=12000.0, cx_px=256.0, cy_px=240.0, kappa_per_px2=1e-9, aspect=0.9617)
    >>> lens.image_from_normalised([[0.0, 0.0]]).xy
    array([[256., 240.]])
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names, with units, of the numbers in :meth:`parameter_jacobian`'s last axis."""
        ...

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        """Map normalised points (..., 2) to image pixels (..., 2)."""
        ...

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        """Map image pixels (..., 2) to normalised points (..., 2)."""
        ...

    def image_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Return d(image px) / d(normalised), (..., 2, 2), at normalised points (..., 2)."""
        ...

    def parameter_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Return d(image px) / d(parameters), (..., 2, n), at normalised points (..., 2)."""
        ...

    def kernel_parameters(self) -> Float:
        """Flat (15,) float64 form for compiled kernels.

        ``[kind, fx, fy, skew, cx, cy, d0, d1, d2, d3, d4, r2_max, d5, d6, d7]`` with kind 0 = Seidel (d0 = kappa phd^2,
        the other d zero) or 1 = OpenCV (d = k1 k2 p1 p2 k3, k4 k5 k6), and r2_max the largest normalised radius squared
        inside the domain. :class:`stereorig.core.cameras.opencv_full.OpenCVFullLens` adds nine.
        """
        ...


@dataclass(frozen=True, slots=True)
class SeidelLens:
    """The paper's lens and sensor: five intrinsic parameters, Eqs. (5) to (8).

    Attributes
    ----------
    phd_px
        Pinhole distance in column pitches.
    cx_px, cy_px
        Image centre.
    kappa_per_px2
        Seidel distortion. ``x_bar = x_sen / (1 + kappa r^2)`` (6), corrected form.
    aspect
        Rows' scale over columns' scale (lambda).
    """

    phd_px: float
    cx_px: float
    cy_px: float
    kappa_per_px2: float
    aspect: float = 1.0

    parameter_names: ClassVar[tuple[str, ...]] = ("phd_px", "cx_px", "cy_px", "kappa_per_px2", "aspect")

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        """Apply Eqs. (5), (6), (8). Valid where |kappa| r^2 < 1, beyond which (6) cannot be inverted."""
        s = np.asarray(xy_norm, dtype=np.float64) * self.phd_px
        kr2 = self.kappa_per_px2 * (s[..., 0] ** 2 + s[..., 1] ** 2)
        valid = np.abs(kr2) < 1.0  # also False for NaN input
        bar = s / np.where(valid, 1.0 + kr2, np.nan)[..., None]
        bar[..., 0] += self.cx_px
        bar[..., 1] = self.aspect * bar[..., 1] + self.cy_px
        return MappedPoints(bar, valid)

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        """Apply Eqs. (8), (7), (5) backwards. Valid where 4 kappa rbar^2 < 1."""
        xy = np.asarray(xy_px, dtype=np.float64)
        bar = np.stack([xy[..., 0] - self.cx_px, (xy[..., 1] - self.cy_px) / self.aspect], axis=-1)
        q = 4.0 * self.kappa_per_px2 * (bar[..., 0] ** 2 + bar[..., 1] ** 2)
        valid = q < 1.0
        root = np.sqrt(np.where(valid, 1.0 - q, np.nan))
        return MappedPoints(bar * (2.0 / (1.0 + root) / self.phd_px)[..., None], valid)

    def image_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate (5), (6), (8) with respect to the normalised point."""
        s = np.asarray(xy_norm, dtype=np.float64) * self.phd_px
        k = self.kappa_per_px2
        d = 1.0 + k * (s[..., 0] ** 2 + s[..., 1] ** 2)
        jac = -2.0 * k * s[..., :, None] * s[..., None, :] / (d**2)[..., None, None]
        jac[..., 0, 0] += 1.0 / d
        jac[..., 1, 1] += 1.0 / d
        jac *= self.phd_px
        jac[..., 1, :] *= self.aspect
        return jac

    def parameter_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate (5), (6), (8) with respect to phd, cx, cy, kappa, aspect."""
        n = np.asarray(xy_norm, dtype=np.float64)
        s = n * self.phd_px
        r2 = s[..., 0] ** 2 + s[..., 1] ** 2
        d = 1.0 + self.kappa_per_px2 * r2
        jac = np.zeros((*n.shape[:-1], 2, 5))
        # along a ray x_sen grows with phd, and r^2 with it
        jac[..., :, 0] = n * ((1.0 - self.kappa_per_px2 * r2) / d**2)[..., None]
        jac[..., 0, 1] = 1.0
        jac[..., 1, 2] = 1.0
        jac[..., :, 3] = -s * (r2 / d**2)[..., None]
        jac[..., 1, 0] *= self.aspect
        jac[..., 1, 3] *= self.aspect
        jac[..., 1, 4] = s[..., 1] / d
        return jac

    def kernel_parameters(self) -> Float:
        """Flat form, see :class:`LensModel`."""
        k = self.kappa_per_px2 * self.phd_px**2
        r2_max = 1.0 / abs(k) if k != 0.0 else np.inf
        flat = np.zeros(N_KERNEL_PARAMETERS)
        flat[:7] = SEIDEL, self.phd_px, self.phd_px * self.aspect, 0.0, self.cx_px, self.cy_px, k
        flat[11] = r2_max
        return flat


@dataclass(frozen=True)
class OpenCVLens:
    """OpenCV's pinhole and distortion model with eight coefficients and a skew; the five-term one has k4 = k5 = k6 = 0.

    ``x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)``, likewise
    y; ``x_img = fx x_d + skew y_d + cx``, ``y_img = fy y_d + cy``.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    parameter_names: ClassVar[tuple[str, ...]] = (
        "fx_px",
        "fy_px",
        "cx_px",
        "cy_px",
        "skew_px",
        "k1",
        "k2",
        "p1",
        "p2",
        "k3",
        "k4",
        "k5",
        "k6",
    )

    @cached_property
    def is_rational(self) -> bool:
        """True if one of k4, k5, k6 is not zero."""
        return self.k4 != 0.0 or self.k5 != 0.0 or self.k6 != 0.0

    @cached_property
    def _r2_max(self) -> float:
        # the radial factor N / D folds back where d/dr [r N / D] = (N D + 2 s (N' D - N D')) / D^2 = 0, s = r^2
        if not self.is_rational:
            return _smallest_positive_root([7.0 * self.k3, 5.0 * self.k2, 3.0 * self.k1, 1.0])
        top = np.polynomial.Polynomial([1.0, self.k1, self.k2, self.k3])
        bottom = np.polynomial.Polynomial([1.0, self.k4, self.k5, self.k6])
        grown = top.deriv() * bottom - top * bottom.deriv()
        slope = top * bottom + np.polynomial.Polynomial([0.0, 2.0]) * grown
        return min(_smallest_positive_root(list(one.coef[::-1])) for one in (slope, bottom))

    def _radial(self, r2: Float) -> Float:
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return radial / self._denominator(r2) if self.is_rational else radial

    def _denominator(self, r2: Float) -> Float:
        return 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))

    def _radial_slope(self, r2: Float, radial: Float) -> Float:
        """Twice the radial factor's derivative with respect to r^2."""
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3))
        if self.is_rational:
            bottom = 2.0 * (self.k4 + r2 * (2.0 * self.k5 + 3.0 * r2 * self.k6))
            slope = (slope - radial * bottom) / self._denominator(r2)
        return slope

    def _distorted(self, n: Float) -> Float:
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        return np.stack(self._shifted(x, y, r2, self._radial(r2)), axis=-1)

    def _shifted(self, x: Float, y: Float, r2: Float, radial: Float) -> tuple[Float, Float]:
        return (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )

    def _distorted_jacobian(self, n: Float) -> Float:
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        jac = np.empty((*n.shape[:-1], 2, 2))
        jac[..., 0, 0], jac[..., 0, 1], jac[..., 1, 0], jac[..., 1, 1] = self._jacobian(x, y, r2, self._radial(r2))
        return jac

    def _jacobian(self, x: Float, y: Float, r2: Float, radial: Float) -> tuple[Float, Float, Float, Float]:
        """Derivatives of the distortion: x by x, x by y, y by x, y by y."""
        slope = self._radial_slope(r2, radial)
        mixed = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        return (
            radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            mixed,
            mixed,
            radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        )

    def _newton_step(self, x: Float, y: Float, to_x: Float, to_y: Float) -> tuple[Float, Float]:
        """Step x, y by which normalised points distort into ``to_x, to_y``, to first order."""
        r2 = x * x + y * y
        radial = self._radial(r2)
        xd, yd = self._shifted(x, y, r2, radial)
        off_x, off_y = xd - to_x, yd - to_y
        xx, xy, yx, yy = self._jacobian(x, y, r2, radial)
        det = xx * yy - xy * yx
        return (yy * off_x - xy * off_y) / det, (xx * off_y - yx * off_x) / det

    def _image(self, d: Float) -> Float:
        return np.stack(
            [self.fx_px * d[..., 0] + self.skew_px * d[..., 1] + self.cx_px, self.fy_px * d[..., 1] + self.cy_px],
            axis=-1,
        )

    def _radially_undistorted(self, d: Float) -> Float:
        """Invert the radial factor alone by bisection on the branch that contains the centre."""
        r_d = np.hypot(d[..., 0], d[..., 1])
        r_max = np.sqrt(self._r2_max)

        def radius(t: Float) -> Float:
            return t * r_max if np.isfinite(r_max) else t / (1.0 - t)

        low, high = np.zeros_like(r_d), np.ones_like(r_d)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            r = radius(middle)
            short = r * self._radial(r * r) < r_d
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return d * np.divide(radius(low), r_d, out=np.ones_like(r_d), where=r_d > 0.0)[..., None]

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        """Distort and map to pixels. Valid where the radius still grows, up to a pole of the radial factor."""
        n = np.asarray(xy_norm, dtype=np.float64)
        valid = n[..., 0] ** 2 + n[..., 1] ** 2 < self._r2_max
        return MappedPoints(self._image(self._distorted(np.where(valid[..., None], n, np.nan))), valid)

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        """Invert by Newton's method; a result whose image differs from the pixel by more than 1e-9 is not valid."""
        xy = np.asarray(xy_px, dtype=np.float64)
        if xy.ndim == 1 or xy.size > _MANY:
            return self._normalised_from_image(xy)
        return (_inverted_few if xy.size < _FEW else _inverted)(self, xy.shape, xy.tobytes())

    def _distorted_from_image(self, xy: Float) -> Float:
        yd = (xy[..., 1] - self.cy_px) / self.fy_px
        return np.stack([(xy[..., 0] - self.cx_px - self.skew_px * yd) / self.fx_px, yd], axis=-1)

    def _normalised_from_image(self, xy: Float) -> MappedPoints:
        d = self._distorted_from_image(xy)
        r_max = np.sqrt(self._r2_max)
        with np.errstate(all="ignore"):  # points that diverge are marked invalid below
            # a quotient may level off or rise to a pole, where Newton's method from d itself would leave the branch
            start = self._radially_undistorted(d) if self.is_rational else d
            to_x, to_y = d[..., 0].copy(), d[..., 1].copy()
            x, y = start[..., 0], start[..., 1]
            for _ in range(_NEWTON_STEPS):
                step_x, step_y = self._newton_step(x, y, to_x, to_y)
                x, y = x - step_x, y - step_y
                if np.isfinite(r_max):  # keep Newton on the branch that contains the centre
                    r = np.hypot(x, y)
                    if (r > r_max).any():
                        back = np.where(r > r_max, 0.999 * r_max / r, 1.0)
                        x, y = x * back, y * back
                if not np.any(np.maximum(np.abs(step_x), np.abs(step_y)) > 1e-14):
                    break
            n = np.stack([x, y], axis=-1)
            error = np.abs(self._distorted(n) - d).max(axis=-1) * max(abs(self.fx_px), abs(self.fy_px))
            valid = error < 1e-9 * np.maximum(1.0, np.abs(xy).max(axis=-1))
        return MappedPoints(np.where(valid[..., None], n, np.nan), valid)

    def image_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate the distortion and the pixel map."""
        return self._in_pixels(self._distorted_jacobian(np.asarray(xy_norm, dtype=np.float64)))

    def _in_pixels(self, jac: Float) -> Float:
        out = np.empty_like(jac)
        out[..., 0, :] = self.fx_px * jac[..., 0, :] + self.skew_px * jac[..., 1, :]
        out[..., 1, :] = self.fy_px * jac[..., 1, :]
        return out

    def parameter_jacobian(self, xy_norm: ArrayLike) -> Float:
        """Differentiate with respect to fx, fy, cx, cy, skew, k1, k2, p1, p2, k3, k4, k5, k6."""
        n = np.asarray(xy_norm, dtype=np.float64)
        return self._by_parameters(self._distorted(n), self._by_terms(n))

    def _by_parameters(self, d: Float, terms: list[tuple[int, Float, Float]]) -> Float:
        """Derivatives of the pixels over the parameters, from sensor points and their derivatives over other terms."""
        jac = np.zeros((*d.shape[:-1], 2, len(self.parameter_names)))
        jac[..., 0, 0] = d[..., 0]
        jac[..., 1, 1] = d[..., 1]
        jac[..., 0, 2] = 1.0
        jac[..., 1, 3] = 1.0
        jac[..., 0, 4] = d[..., 1]
        for column, dx, dy in terms:
            jac[..., 0, column] = self.fx_px * dx + self.skew_px * dy
            jac[..., 1, column] = self.fy_px * dy
        return jac

    def _by_terms(self, n: Float) -> list[tuple[int, Float, Float]]:
        """Derivatives of the distorted point x and y over each term, with its column."""
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        # the radial factor is N / D: its derivatives are N's over D, minus N / D times D's over D
        bottom = self._denominator(r2) if self.is_rational else np.ones_like(r2)
        radial = self._radial(r2)
        terms = [(7, 2.0 * x * y, r2 + 2.0 * y * y), (8, r2 + 2.0 * x * x, 2.0 * x * y)]
        for power, over, under in ((1, 5, 10), (2, 6, 11), (3, 9, 12)):
            dx, dy = x * r2**power / bottom, y * r2**power / bottom
            terms += [(over, dx, dy), (under, -radial * dx, -radial * dy)]
        return terms

    def kernel_parameters(self) -> Float:
        """Flat form, see :class:`LensModel`."""
        return np.array(
            [
                OPENCV,
                self.fx_px,
                self.fy_px,
                self.skew_px,
                self.cx_px,
                self.cy_px,
                self.k1,
                self.k2,
                self.p1,
                self.p2,
                self.k3,
                self._r2_max,
                self.k4,
                self.k5,
                self.k6,
            ]
        )


def _inverted_at(lens: OpenCVLens, shape: tuple[int, ...], pixels: bytes) -> MappedPoints:
    found = lens._normalised_from_image(np.frombuffer(pixels).reshape(shape))
    found.xy.flags.writeable = found.valid.flags.writeable = False
    return found


# pixels that were asked for lately: every step of a sequence asks a dozen times for the same, growth twice a wave
_inverted, _inverted_few = lru_cache(maxsize=8)(_inverted_at), lru_cache(maxsize=4)(_inverted_at)


def _smallest_positive_root(coefficients: list[float]) -> float:
    """Return the smallest positive real root of a polynomial, highest power first; infinity if it has none."""
    roots = np.roots(coefficients)
    real = roots[np.abs(roots.imag) < 1e-12 * np.maximum(1.0, np.abs(roots))].real
    real = real[real > 0.0]
    return float(real.min()) if real.size else float("inf")
