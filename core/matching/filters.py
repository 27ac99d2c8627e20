"""Filters that run over an image's rows and columns: the splines' prefilter and derivatives as short convolutions.

The exact prefilter of a B-spline is recursive; on an image that continues as its mirror it equals a convolution whose
taps fall off by 0.27 (cubic) or 0.43 (quintic) a pixel. Cut where float32 ends, it is three times faster than the
recursion, works in bands, and releases the GIL.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.threads import run_ranges, threads

CUT = 1e-8
"""Taps below this share of the largest are left out: less than float32 rounds."""

_BAND_ROWS = 512
_PERIOD = 512
_READS = (np.uint8, np.uint16, np.float32)  # types that OpenCV filters into float32 without a copy


@cache
def prefilter(order: int) -> Float:
    """Taps (2 r + 1,) that turn grey levels into B-spline coefficients, along one axis; they sum to 1."""
    return _taps(1.0 / _sampled(order))


@cache
def derivative(order: int) -> Float:
    """Taps (2 r + 1,) that turn grey levels into the spline's derivative at the pixel centres, to be correlated.

    The spline passes through the pixels, so no filter is needed along the other axis.
    """
    w = 2.0 * np.pi * np.arange(_PERIOD) / _PERIOD
    slope = np.sin(w) if order == 3 else (20.0 * np.sin(w) + 2.0 * np.sin(2.0 * w)) / 24.0
    # correlation and convolution with antisymmetric taps differ in sign
    return -_taps(1j * slope / _sampled(order))


def correlate(image: NDArray[Any], along_y: Float, along_x: Float, out: Float32) -> None:
    """Correlate an image with two filters of odd length; the image continues as its mirror about its outermost pixels.

    Parameters
    ----------
    image
        (rows, cols), any real type.
    along_y, along_x
        Taps.
    out
        (rows, cols) float32, may be a view.
    """
    fy, fx = along_y.astype(np.float32), along_x.astype(np.float32)

    def band(source: NDArray[Any]) -> Any:
        return cv2.sepFilter2D(source, cv2.CV_32F, fx, fy, borderType=cv2.BORDER_REFLECT_101)

    in_bands(image, len(along_y) // 2, band, out)


def in_bands(image: NDArray[Any], reach: int, function: Callable[[NDArray[Any]], Any], out: Float32) -> None:
    """Fill ``out`` band by band, on all threads, with ``function`` of the band and ``reach`` rows on either side."""
    rows = image.shape[0]

    def work(first: int, last: int) -> None:
        top, bottom = max(0, first - reach), min(rows, last + reach)
        source = image[top:bottom]
        if source.dtype.type not in _READS:
            source = source.astype(np.float32)
        out[first:last] = function(np.ascontiguousarray(source))[first - top : last - top]

    run_ranges(work, rows, max(reach + 1, min(_BAND_ROWS, -(-rows // threads()))))


def _sampled(order: int) -> Float:
    w = 2.0 * np.pi * np.arange(_PERIOD) / _PERIOD
    if order == 3:
        return np.asarray((4.0 + 2.0 * np.cos(w)) / 6.0)
    return np.asarray((66.0 + 52.0 * np.cos(w) + 2.0 * np.cos(2.0 * w)) / 120.0)


def _taps(spectrum: NDArray[Any]) -> Float:
    taps = np.fft.fftshift(np.fft.ifft(spectrum).real)
    half = _PERIOD // 2
    r = int(np.flatnonzero(np.abs(taps[half:]) > CUT * np.abs(taps).max())[-1])
    taps = taps[half - r : half + r + 1]
    taps.flags.writeable = False
    return taps
