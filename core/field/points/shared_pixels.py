"""Correlation of the errors of two points of a field: subsets that overlap share pixels and their noise.

A patch's value at its centre is a weighted sum of its pixels' noise. For a plane patch the weights are even over the
subset, so that two subsets' errors correlate by the share of common pixels. A curved patch fits the second order too;
its weights at the centre follow the even Legendre polynomials up to degree 2, larger in the middle and negative at the
corners, and its errors correlate over less than its subset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import Smoothing, weight_products, weight_square

_P2_WEIGHT = -2.5  # (2 n + 1) P_n(0) for n = 2, relative to 1 for n = 0
_AT_ONCE = 256
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True)
class SharedPixels:
    """Correlation of two points' errors over the distance of their subsets' centres.

    Attributes
    ----------
    subset_px
        Width of the square subset.
    curved
        True for patches of the second order.
    smoothing
        Smoothing of the displacements; None: they are as measured. With it, this is the correlation of smoothed
        displacements, in whole windows; ``positions`` gives the positions'.
    """

    subset_px: float
    curved: bool = False
    smoothing: Smoothing | None = None

    def __post_init__(self) -> None:
        """Raise ``invalid_input`` for a subset without width."""
        if not (np.isfinite(self.subset_px) and self.subset_px >= 1.0):
            raise InputError(
                f"The subset is {self.subset_px} px wide.", remedy="Give the subset the field was made with."
            )

    @staticmethod
    def of(field: Field, subset_px: float) -> SharedPixels:
        """Return the correlation that fits a field's patches; plane where the field has no record of them."""
        patch = field.patch
        if patch is None:
            return SharedPixels(subset_px, smoothing=field.smoothing)
        return SharedPixels(patch.width_px or subset_px, patch.patch == "quadratic", field.smoothing)

    @property
    def positions(self) -> SharedPixels:
        """Correlation of the points' positions, which are never smoothed."""
        return self if self.smoothing is None else replace(self, smoothing=None)

    @property
    def reach_px(self) -> float:
        """Largest distance of two points whose errors are correlated."""
        more = 0.0 if self.smoothing is None else (self.smoothing.window - 1) * self.smoothing.spacing_px
        return self.subset_px + more

    def correlation(self, dx_px: ArrayLike, dy_px: ArrayLike) -> Float:
        """Return the correlation coefficient of two points at a distance of ``dx_px, dy_px``, any shape."""
        if self.smoothing is None:
            return self._of_subsets(dx_px, dy_px)
        of = self.smoothing
        products = weight_products(of.window, of.order)
        return self._smoothed(products, dx_px, dy_px) / self._smoothed(products, 0.0, 0.0)

    def correlation_with_position(self, dx_px: ArrayLike, dy_px: ArrayLike) -> Float:
        """Return the decrease of the covariance of position and displacement with their points' distance, 1 at zero."""
        if self.smoothing is None:
            return self._of_subsets(dx_px, dy_px)
        of = self.smoothing
        weights = weight_square(of.window, of.order)
        return self._smoothed(weights, dx_px, dy_px) / self._smoothed(weights, 0.0, 0.0)

    def factors(self, dx_px: ArrayLike, dy_px: ArrayLike, n: int) -> Float:
        """Return (..., n, n), the decrease of a covariance of X Y Z (U V W) with distance, by element; 1 at zero."""
        own = self.positions.correlation(dx_px, dy_px)
        out = np.empty((*own.shape, n, n))
        out[...] = own[..., None, None]
        if n > 3 and self.smoothing is not None:
            mixed = self.correlation_with_position(dx_px, dy_px)[..., None, None]
            out[..., :3, 3:], out[..., 3:, :3] = mixed, mixed
            out[..., 3:, 3:] = self.correlation(dx_px, dy_px)[..., None, None]
        return out

    def _smoothed(self, weights: Float, dx_px: ArrayLike, dy_px: ArrayLike) -> Float:
        """Sum (...) of weights, about the middle of a square of steps, times the subsets' correlation from there."""
        assert self.smoothing is not None
        dx, dy = np.broadcast_arrays(np.asarray(dx_px, dtype=np.float64), np.asarray(dy_px, dtype=np.float64))
        # even both ways, and the same distances again and again
        distance = np.round(np.abs(dx), 6) + 1j * np.round(np.abs(dy), 6)
        each, back = np.unique(distance, return_inverse=True)
        lag = (np.arange(len(weights)) - len(weights) // 2) * self.smoothing.spacing_px
        out = np.empty(len(each))
        for first in range(0, len(each), _AT_ONCE):
            some = each[first : first + _AT_ONCE, None, None]
            out[first : first + _AT_ONCE] = np.einsum(
                "kij,ij->k", self._of_subsets(some.real + lag[None, None, :], some.imag + lag[None, :, None]), weights
            )
        return np.asarray(out[back.reshape(dx.shape)])

    def _of_subsets(self, dx_px: ArrayLike, dy_px: ArrayLike) -> Float:
        """Correlation of two subsets' values."""
        a, b = (np.minimum(np.abs(np.asarray(d, dtype=np.float64)) / self.subset_px, 1.0) for d in (dx_px, dy_px))
        if not self.curved:
            return np.asarray((1.0 - a) * (1.0 - b))
        (a00, a02, a22), (b00, b02, b22) = _products(a), _products(b)
        w = _P2_WEIGHT
        # (1 + w P2(x) + w P2(y)) times itself shifted, integrated over the overlap; even in each shift
        total = (
            a00 * b00 + 2.0 * w * (a02 * b00 + a00 * b02) + w * w * (a22 * b00 + a00 * b22) + 2.0 * w * w * a02 * b02
        )
        return np.asarray(total / (4.0 * (1.0 + 2.0 * w * w / 5.0)))

    def summed(self, field: Field, values: Float) -> Float:
        """Return for each point the sum over all points j of correlation_ij values_j.

        Parameters
        ----------
        field
            The grid; its points must be on a regular grid.
        values
            (r, c, ...) zero at points that take no part.
        """
        from scipy.signal import oaconvolve  # slow to load, and not every start needs it

        step_x, step_y = steps_px(field)
        rows, cols = field.shape
        reach_x = min(int(np.ceil(self.reach_px / step_x)), cols - 1) if cols > 1 else 0
        reach_y = min(int(np.ceil(self.reach_px / step_y)), rows - 1) if rows > 1 else 0
        kernel = self.correlation(
            np.arange(-reach_x, reach_x + 1)[None, :] * step_x, np.arange(-reach_y, reach_y + 1)[:, None] * step_y
        )
        kernel = kernel.reshape(kernel.shape + (1,) * (values.ndim - 2))
        full = oaconvolve(values, kernel, mode="full", axes=(0, 1))
        return np.asarray(full[reach_y : reach_y + rows, reach_x : reach_x + cols])


def _products(shift: Float) -> tuple[Float, Float, Float]:
    """Integrals of 1 * 1, 1 * P2 and P2 * P2 over the overlap of [-1, 1] with itself moved by 2 ``shift``."""
    half = 1.0 - shift  # the overlap is [-1 + 2 shift, 1]: half as wide as this on either side of shift
    x = shift[..., None] + half[..., None] * _NODES
    moved = x - 2.0 * shift[..., None]
    p, q = 1.5 * x**2 - 0.5, 1.5 * moved**2 - 0.5
    return 2.0 * half, half * (p @ _WEIGHTS), half * ((p * q) @ _WEIGHTS)


def steps_px(field: Field) -> tuple[float, float]:
    """Return the distances of neighbouring columns and rows; 1 for a single one.

    Raises
    ------
    InputError
        ``grid_irregular`` if the points are not on a regular grid along rows and columns.
    """
    x, y = field.x_px[0], field.y_px[:, 0]
    step_x = float(x[-1] - x[0]) / (len(x) - 1) if len(x) > 1 else 1.0
    step_y = float(y[-1] - y[0]) / (len(y) - 1) if len(y) > 1 else 1.0
    regular = (
        step_x > 0.0
        and step_y > 0.0
        and np.allclose(field.x_px, x[0] + step_x * np.arange(len(x))[None, :], rtol=0.0, atol=1e-6)
        and np.allclose(field.y_px, y[0] + step_y * np.arange(len(y))[:, None], rtol=0.0, atol=1e-6)
    )
    if not regular:
        raise InputError(
            "The field's points do not lie on a regular grid of pixels.",
            code="grid_irregular",
            remedy="Use a field as it was measured.",
        )
    return step_x, step_y


def roots_of(covariance: Float) -> Float:
    """Return the symmetric roots S of covariances (..., n, n), S S = C; rounding below zero counts as zero."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2))
