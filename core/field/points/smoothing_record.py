"""Record of the smoothing of a displacement: settings, counts, and its weights.

A smoothed value is a weighted sum of the values of a window. So is its error, and neighbours have more of it in common
than their subsets' pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.core.field.region.window import fit_terms, window_offsets
from stereorig.core.settings import SMOOTHING_WINDOW

Order = Literal[1, 2]


@dataclass(frozen=True, kw_only=True)
class Smoothing:
    """Smoothing of a displacement.

    Attributes
    ----------
    window
        Points across the square window, odd.
    order
        Order of the polynomial: 1 plane, 2 quadratic.
    spacing_px, subset_px
        Spacing and subset of the field.
    resolution_px
        Width of the area that one value averages, (window - 1) spacing + subset.
    resolution_mm
        The same on the surface, median of the field; None if no point is valid.
    whole, reduced, raw
        Numbers of points with values of whole windows; of windows that edges, holes or cuts have reduced; and with
        their own value, because a fit over the points left would be noisier.
    """

    window: int
    order: Order = 2
    spacing_px: float
    subset_px: float
    resolution_px: float
    resolution_mm: float | None
    whole: int
    reduced: int
    raw: int

    def document(self) -> dict[str, Any]:
        """Return the record as plain values."""
        return asdict(self)

    @staticmethod
    def from_document(document: Mapping[str, Any]) -> Smoothing:
        """Return the record from :meth:`document`; unknown entries are left out."""
        known = {f.name for f in fields(Smoothing)}
        return Smoothing(**{name: value for name, value in document.items() if name in known})


def check_smoothing(window: int, order: int = 2) -> None:
    """Raise an error for a window or an order out of range.

    Raises
    ------
    InputError
        ``smoothing_window_invalid``, ``option_out_of_range``.
    """
    if not SMOOTHING_WINDOW.holds(window):
        raise InputError(
            f"the smoothing window is {window} points wide; it must be {SMOOTHING_WINDOW}.",
            code="smoothing_window_invalid",
            remedy=f"Give {SMOOTHING_WINDOW.default}, for example, or switch smoothing off.",
        )
    if order not in (1, 2):
        raise InputError(
            f"the smoothing's order is {order}, it must be 1 or 2.",
            code="option_out_of_range",
            remedy="Give 1 for planes or 2 for quadratics.",
        )


@lru_cache(maxsize=8)
def whole_weights(window: int, order: int) -> Float:
    """Return (window^2,) weights of a whole window's points, in the order of ``window_offsets``; they sum to 1."""
    half = window // 2
    A = fit_terms(window_offsets(half)[0], half, order)
    return np.asarray(np.linalg.solve(A.T @ A, A.T)[0])


@lru_cache(maxsize=8)
def weight_square(window: int, order: int) -> Float:
    """Return the same weights as a square (window, window) of rows and columns."""
    half = window // 2
    out = np.zeros((window, window))
    row, col = window_offsets(half)[0].T
    out[row + half, col + half] = whole_weights(window, order)
    return out


@lru_cache(maxsize=8)
def weight_products(window: int, order: int) -> Float:
    """Return (2 window - 1, 2 window - 1) sums over pairs of a window's points, by distance in rows and columns."""
    from scipy.signal import correlate  # slow to load, and not every start needs it

    square = weight_square(window, order)
    return np.asarray(correlate(square, square, mode="full", method="direct"))


# Record of a dense field: the measurement of its vectors, and the error that neighbours share.

METHOD = "dense, shared windows"
"""Name of the method in files, documents and on the page."""

NEIGHBOURS = (
    "each vector is measured over the whole window about it; windows of neighbours overlap, and errors of two vectors "
    "dx, dy px apart correlate by the share of common pixels, (1 - |dx| / window) (1 - |dy| / window)"
)


@dataclass(frozen=True, kw_only=True)
class DenseRecord:
    """Record of a dense field's measurement.

    Attributes
    ----------
    step_px
        Distance of its vectors.
    window_px
        Width of the window that each is measured over: the ordinary field's subset.
    spacing_px
        Distance of the ordinary field's points, which made the prediction.
    variance_ratio
        Median of the ordinary field's variance over the variance from the vectors' own normal equations, (grey
        levels)^2: image noise and all errors that the ordinary field's tests found in addition. None if no vector has
        one.
    """

    step_px: int
    window_px: int
    spacing_px: float
    variance_ratio: float | None

    def document(self) -> dict[str, Any]:
        """Return the record as plain values."""
        return asdict(self)

    @staticmethod
    def from_document(document: Mapping[str, Any]) -> DenseRecord:
        """Return the record from :meth:`document`; unknown entries are left out."""
        known = {f.name for f in fields(DenseRecord)}
        return DenseRecord(**{name: value for name, value in document.items() if name in known})
