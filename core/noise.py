"""A camera's noise, measured from repeated frames of one scene: variance against grey level.

A sensor's noise is read noise, the same everywhere, and shot noise, whose variance grows with the light: ``variance =
c0 + c1 g`` in grey levels squared, with a small ``c2 g^2`` where the camera's output is not linear. The model weighs a
subset's pixels and gives the covariance of a match without an estimate from residuals (photon transfer, EMVA 1288).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.errors import ImageError, InputError

MAX_SHIFT_PX = 0.1
"""Largest motion from one frame to the next: beyond it the first-order correction does not hold."""
MAX_EXCESS = 0.25
"""Largest excess of the variance at steep pixels over that at flat ones of the same grey level."""

MAX_TEXTURE = 0.05
"""Largest share of an even field's variance that is common to pixels two rows and columns apart. Lines and single
pixels have no such part, but an image of any object has.
"""
_SHADING_PX = 12.0  # standard deviation of the smoothing that estimates light and lens
_DEFECT = 8.0  # robust sd of the pattern from pixel to pixel

_BINS = 48
_MIN_PIXELS = 400  # pixels of a bin, at least
_MAX_PIXELS = 600_000  # used in one frame; more do not improve the result
_OUTLIER = 6.0  # sd of a difference
_CLIPPED_SD = 3.0  # distance from black and white, in sd, below which a level's noise is cut off
_CLEAR = 0.25  # share of the variance at the lowest level seen
_SURE = 4.0  # standard deviations of a significant coefficient


@dataclass(frozen=True, eq=False)
class SensorMap:
    """Fixed pattern and defects of a sensor, in all its images.

    Attributes
    ----------
    pattern
        (rows, cols) float32 grey levels that the sensor adds: fixed columns, rows and pixels.
    defects
        (m,) int64 flat indices of pixels that follow the light no more, or hardly: dead, hot, under dust.
    """

    pattern: Float32
    defects: NDArray[np.int64]

    def subtracted_from(self, image: NDArray[Any], name: str = "the image") -> Float32:
        """Return an image (rows, cols) without the pattern, float32.

        Raises
        ------
        ImageError
            ``image_size_mismatch``.
        """
        if image.shape != self.pattern.shape:
            (rows, cols), (own_rows, own_cols) = image.shape, self.pattern.shape
            raise ImageError(
                f"{name} is {cols} x {rows} px, the map of its sensor {own_cols} x {own_rows} px.",
                code="image_size_mismatch",
                remedy="Give the map of this camera, with this window of its sensor.",
            )
        return np.asarray(image - self.pattern, dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Variance of a pixel's noise against its grey level.

    Attributes
    ----------
    coefficients
        c0, c1, c2 of ``c0 + c1 g + c2 g^2``: grey levels squared, grey levels, 1.
    coefficients_sd
        Their standard deviations; 0 for a coefficient that was left out.
    range_grey
        Range of the polynomial: the levels seen without clipping, and for a line all the converter's. Beyond it the
        nearest end's variance is taken.
    frames
        Number of frames it was measured from.
    levels, variances, variances_sd
        (k,) measured mean grey level, variance and its standard deviation, bin by bin.
    misfit
        Root mean square of (measured - model) / sd over the bins; 1 for a perfect model.
    drift
        Largest relative change of brightness between consecutive frames; corrected.
    shift_px
        Largest motion of the image between consecutive frames; corrected to first order.
    excess
        Excess of the variance of steep pixels over flat ones of the same grey level: 0 in a still scene.
    sensor
        Fixed pattern and defective pixels, subtracted and left out where images are measured; None: not known.
    """

    coefficients: tuple[float, float, float]
    coefficients_sd: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_grey: tuple[float, float] = (-np.inf, np.inf)
    frames: int = 0
    levels: tuple[float, ...] = ()
    variances: tuple[float, ...] = ()
    variances_sd: tuple[float, ...] = ()
    misfit: float = 0.0
    drift: float = 0.0
    shift_px: float = 0.0
    excess: float = 0.0
    sensor: SensorMap | None = None

    def __post_init__(self) -> None:
        low, high = self.range_grey
        if not (low < high and np.isfinite(self.coefficients).all()):
            raise InputError(
                f"a noise model over grey levels {low:g} to {high:g} with coefficients {self.coefficients} is none.",
                code="noise_model_invalid",
            )
        ends = self.variance([v for v in (low, high) if np.isfinite(v)] or [0.0])
        if not (ends > 0.0).all():
            raise InputError(
                f"the noise model gives a variance of {float(ends.min()):g} inside its range; it must be positive.",
                code="noise_model_invalid",
            )

    def variance(self, grey: ArrayLike) -> Float:
        """Variance (...) in grey levels squared at grey levels (...)."""
        g = np.clip(np.asarray(grey, dtype=np.float64), *self.range_grey)
        c0, c1, c2 = self.coefficients
        return np.asarray(c0 + g * (c1 + g * c2))

    def averaged(self, frames: int, scale: float = 1.0) -> NoiseModel:
        """Return the model of means over ``frames`` frames, with grey levels multiplied by ``scale``."""
        if frames < 1 or not scale > 0.0:
            raise InputError(f"{frames} frames, scale {scale:g}: no mean.", code="option_out_of_range")
        factors = tuple(scale**power / frames for power in (2, 1, 0))
        low, high = self.range_grey
        c, s = self.coefficients, self.coefficients_sd
        return NoiseModel(
            coefficients=(c[0] * factors[0], c[1] * factors[1], c[2] * factors[2]),
            coefficients_sd=(s[0] * factors[0], s[1] * factors[1], s[2] * factors[2]),
            range_grey=(low * scale, high * scale),
            frames=self.frames,
            levels=tuple(v * scale for v in self.levels),
            variances=tuple(v * factors[0] for v in self.variances),
            variances_sd=tuple(v * factors[0] for v in self.variances_sd),
            misfit=self.misfit,
            drift=self.drift,
            shift_px=self.shift_px,
            excess=self.excess,
            # the fixed pattern is in each frame, and so in their mean
            sensor=self.sensor and SensorMap(np.float32(scale) * self.sensor.pattern, self.sensor.defects),
        )

    def times(self, factor: float) -> NoiseModel:
        """Return the model of images whose noise has ``factor`` times this variance at the same grey levels."""
        if not 0.0 < factor < np.inf:
            raise InputError(f"a noise variance times {factor:g} is none.", code="option_out_of_range")
        c, s = self.coefficients, self.coefficients_sd
        return replace(
            self,
            coefficients=(c[0] * factor, c[1] * factor, c[2] * factor),
            coefficients_sd=(s[0] * factor, s[1] * factor, s[2] * factor),
            variances=tuple(v * factor for v in self.variances),
            variances_sd=tuple(v * factor for v in self.variances_sd),
        )


def measure_noise(frames: Sequence[ArrayLike], *, full_scale: float | None = None) -> NoiseModel:
    """Measure a camera's noise from frames of a still scene.

    Parameters
    ----------
    frames
        Two or more images (rows, cols) of one camera with one setting, in the order in which they were taken. The more
        grey levels the scene has, the better; a speckled specimen is enough.
    full_scale
        Grey level at which the converter ends; from the type of integer images, or the largest value that more than a
        thousandth of the pixels share, when left out.

    Returns
    -------
    NoiseModel
        In the frames' grey levels. Rounding to whole grey levels is part of it.

    Raises
    ------
    InputError
        ``too_few_frames``.
    ImageError
        ``image_size_mismatch``, ``image_type``; ``frames_identical`` if nothing differs, ``frames_not_static`` if the
        scene moved or changed, ``image_saturated`` if hardly a pixel is free of clipping.

    Notes
    -----
    Consecutive frames are subtracted, so that slow drift cancels. The effects of a change of brightness and of a shift
    of the whole image on each difference are removed by least squares. Half the mean square of the rest, in bins of
    grey level, is the variance; the polynomial is fitted with the bins' own uncertainties.
    """
    images = _checked(frames)
    mean: Float = np.asarray(np.mean(images, axis=0, dtype=np.float64))
    gy, gx = np.gradient(mean)
    if full_scale is None:
        full_scale = _full_scale(frames, images)
    free = _unclipped(images, full_scale)
    steep = np.asarray(np.hypot(gx, gy))
    basis = np.stack([np.ones_like(mean), mean, gx, gy], axis=-1)
    differences, drift, shift = [], 0.0, 0.0
    for a, b in pairwise(images):
        rest, gain, moved = _still(b.astype(np.float64) - a, basis, free)
        drift, shift = max(drift, gain), max(shift, moved)
        differences.append(rest.astype(np.float32))
    if shift > MAX_SHIFT_PX:
        raise _not_static(f"they move by {shift:.2f} px from one frame to the next")
    square: Float32 = np.float32(0.5) * np.stack(differences) ** 2
    bins = _binned(mean, square, free, steep)
    excess, levels = bins.excess, bins.levels
    if excess > MAX_EXCESS and excess > _SURE * bins.excess_sd:
        raise _not_static(
            f"pixels on steep slopes vary by {100 * excess:.0f} % more than flat ones of the same grey level"
        )
    c, sd, misfit = _fit(levels, bins.variances, bins.sds)
    low, high = float(levels[0]), float(levels[-1])
    if c[2] == 0.0:  # a line is valid beyond the levels seen, as far as it stays clear of zero
        low = 0.0 if low > 0.0 and c[0] > _CLEAR * (c[0] + c[1] * low) else low
        high = full_scale if high < full_scale < np.inf and c[1] >= 0.0 else high
    return NoiseModel(
        coefficients=c,
        coefficients_sd=sd,
        range_grey=(low, high),
        frames=len(images),
        levels=tuple(map(float, levels)),
        variances=tuple(map(float, bins.variances)),
        variances_sd=tuple(map(float, bins.sds)),
        misfit=misfit,
        drift=drift,
        shift_px=shift,
        excess=float(excess),
    )


def measure_pattern(frames: Sequence[ArrayLike]) -> SensorMap:
    """Measure a sensor's fixed pattern and defective pixels from frames of an even field.

    Parameters
    ----------
    frames
        Two or more images (rows, cols) of one camera, of a diffuser or out of focus, at about the grey levels of the
        test. A specimen in focus is not suitable: its texture stays in place, as the pattern does.

    Returns
    -------
    SensorMap
        In the frames' grey levels. A pattern no larger than the frames' own noise is not in it.

    Raises
    ------
    InputError
        ``too_few_frames``.
    ImageError
        As :func:`measure_noise`; ``frames_not_even`` if the frames show more than an even field.
    """
    images = _checked(frames, whole=True)
    free = _unclipped(images, _full_scale(frames, images))
    mean: Float = np.mean(images, axis=0, dtype=np.float64)
    noise = float(np.mean(np.var(np.stack([image[::4] for image in images]), axis=0, ddof=1, dtype=np.float64)))
    noise /= len(images)
    rest, bad = _without_shading(mean, ~free), ~free
    for _ in range(2):  # a defect raises the pixels about it
        column, row, own = _parts_of(rest, bad)
        limit = _DEFECT * 1.4826 * float(np.median(np.abs(own[~bad])))
        bad = ~free | (np.abs(own) > max(limit, 1e-6))
        rest = _without_shading(mean, bad)
    column, row, own = _parts_of(rest, bad)
    own[bad] = 0.0
    variance = float((own[~bad] ** 2).mean())
    # an image correlates both ways; lines and pixels do so along their own line at most
    shared = float(np.mean(own[2:, 2:] * own[:-2, :-2] + own[2:, :-2] * own[:-2, 2:])) / 2.0
    if shared > MAX_TEXTURE * variance and shared > _SURE * variance / np.sqrt(own.size):
        raise ImageError(
            f"the frames show more than an even field: pixels two rows and columns apart share "
            f"{100 * shared / variance:.0f} % of what is fixed, {100 * MAX_TEXTURE:.0f} % at most is a sensor's own.",
            code="frames_not_even",
            remedy="Take them of a diffuser, or far out of focus, at about the grey levels of the test.",
        )
    true = max(variance - noise, 0.0) / max(variance, 1e-30)
    pattern = (column[None, :] + row[:, None] + true * own).astype(np.float32)
    return SensorMap(pattern, np.flatnonzero(bad).astype(np.int64))


def _without_shading(mean: Float, bad: Bool) -> Float:
    """A mean frame less its slowly varying part; bad pixels have no part in it."""
    weight = (~bad).astype(np.float64)
    smooth, share = (
        cv2.GaussianBlur(values, (0, 0), _SHADING_PX, borderType=cv2.BORDER_REFLECT_101)
        for values in (mean * weight, weight)
    )
    return np.asarray(mean - smooth / np.maximum(share, 1e-6))


def _parts_of(rest: Float, bad: Bool) -> tuple[Float, Float, Float]:
    """Columns (cols,), rows (rows,), and the remainder of single pixels (rows, cols)."""
    usual = np.ma.masked_array(rest, bad)
    column = usual.mean(axis=0).filled(0.0)
    row = (usual - column).mean(axis=1).filled(0.0)
    return np.asarray(column), np.asarray(row), np.asarray(rest - column[None, :] - row[:, None])


def _not_static(cause: str) -> ImageError:
    return ImageError(
        f"the frames do not show a still scene: {cause}.",
        code="frames_not_static",
        remedy="Take the frames in one go, with nothing loaded or touched, and a steady light.",
    )


def _checked(frames: Sequence[ArrayLike], *, whole: bool = False) -> list[NDArray[Any]]:
    images = [np.asarray(frame) for frame in frames]
    if len(images) < 2:
        raise InputError(
            f"{len(images)} frame given, noise shows in two or more.",
            code="too_few_frames",
            remedy="Capture the same scene several times.",
        )
    first = images[0].shape
    for k, image in enumerate(images):
        if image.ndim != 2 or image.dtype.kind not in "uif" or min(image.shape) < 16:
            raise ImageError(
                f"frame {k} has the shape {image.shape} and type {image.dtype}; it must be gray, 16 px or more.",
                code="image_type",
            )
        if image.shape != first:
            raise ImageError(
                f"frame {k} is {image.shape[1]} x {image.shape[0]} px, the first {first[1]} x {first[0]} px.",
                code="image_size_mismatch",
                remedy="Give frames of one camera.",
            )
        if image.dtype.kind == "f" and not np.isfinite(image).all():
            raise ImageError(f"frame {k} holds NaN or infinite grey levels.", code="image_not_finite")
    for k in range(1, len(images)):
        if np.array_equal(images[k - 1], images[k]):
            raise ImageError(
                f"frames {k - 1} and {k} are the same, grey level by grey level.",
                code="frames_identical",
                remedy="Give different frames, not copies of one; a camera without noise needs no model.",
            )
    rows = slice(None) if whole else rows_looked_at(first)
    return [image[rows] for image in images]


def rows_looked_at(shape: tuple[int, ...]) -> slice:
    """Return the rows of frames (rows, cols) that :func:`measure_noise` uses: a band in the middle of large ones."""
    count = shape[0]
    height = max(min(count, _MAX_PIXELS // shape[1]), min(count, 16))
    top = (count - height) // 2
    return slice(top, top + height)


def _full_scale(frames: Sequence[ArrayLike], images: list[NDArray[Any]]) -> float:
    top = max(float(image.max()) for image in images)
    if all(np.asarray(frame).dtype == np.uint8 for frame in frames):
        return 255.0
    # 10 and 12 bits come in 16: where many pixels share the largest value, it is the converter's end
    share = np.mean([np.mean(image == top) for image in images])
    if share > 1e-3:
        return top
    return 65535.0 if images[0].dtype == np.uint16 else np.inf


def _unclipped(images: list[NDArray[Any]], full_scale: float) -> Bool:
    low, high = np.minimum.reduce(images), np.maximum.reduce(images)
    bottom = 0.0 if images[0].dtype.kind == "u" else -np.inf
    free = (low > bottom) & (high < full_scale)
    if free.mean() < 0.01:
        raise ImageError(
            f"{100 * (1 - free.mean()):.1f} % of the pixels are black or saturated; their noise is cut off.",
            code="image_saturated",
            remedy="Change exposure or light.",
        )
    return np.asarray(free)


def _still(difference: Float, basis: Float, free: Bool) -> tuple[Float, float, float]:
    """A difference of two frames without change of brightness and shift; the relative change, and the shift in px."""
    A, d = basis[free], difference[free]
    x = np.zeros(basis.shape[-1])
    keep = np.ones(len(d), bool)
    for _ in range(3):
        a = A[keep]
        scale = np.sqrt((a * a).mean(axis=0)) + 1e-30
        a = a / scale
        x = np.linalg.lstsq(a.T @ a, a.T @ d[keep], rcond=1e-10)[0] / scale
        rest = d - A @ x
        keep = np.abs(rest) <= _OUTLIER * max(float(np.sqrt(np.mean(rest[keep] ** 2))), 1e-30)
    middle = float(A[:, 1].mean())
    gain = abs(x[0] + x[1] * middle) / max(middle, 1e-30)
    return difference - basis @ x, float(gain), float(np.hypot(x[2], x[3]))


class _Bins(NamedTuple):
    """Mean grey levels, variances and their standard deviations by bins; excess of the steep pixels with its own."""

    levels: Float
    variances: Float
    sds: Float
    excess: float
    excess_sd: float


def _binned(mean: Float, square: Float32, free: Bool, steep: Float) -> _Bins:
    g, v, s = mean[free], square[:, free], steep[free]
    order = np.argsort(g, kind="stable")
    count = int(np.clip(len(g) // _MIN_PIXELS, 1, _BINS))
    # half the differences share a frame with their neighbour: 1.5 times the variance of independent ones
    repeat = 1.0 if len(v) == 1 else 1.5
    levels, variances, sds, ratio, weight = [], [], [], 0.0, 0.0
    near = np.quantile(g, [0.0, 1.0])
    for part in np.array_split(order, count):
        values = v[:, part]
        limit = _OUTLIER**2 * max(float(values.mean(dtype=np.float64)), 1e-30)
        while True:  # outliers (a fly, a flash), until there are none
            kept = values <= limit
            new = _OUTLIER**2 * max(float(values[kept].mean(dtype=np.float64)), 1e-30)
            if new >= 0.99 * limit:
                break
            limit = new
        variance, n = float(values[kept].mean(dtype=np.float64)), int(kept.sum())
        flat = s[part] <= np.median(s[part])
        a, b = values[:, flat], values[:, ~flat]
        a, b = a[a <= limit], b[b <= limit]
        if variance > 0.0 and a.size and b.size and a.mean() > 0.0:
            ratio += part.size * (b.mean() / a.mean() - 1.0)
            weight += part.size
        levels.append(float(g[part].mean()))
        variances.append(variance)
        sds.append(max(variance, 1e-12) * np.sqrt(2.0 * repeat / max(n, 1)))
    g_bin, v_bin, sd_bin = np.array(levels), np.array(variances), np.array(sds)
    sd = np.sqrt(v_bin)
    inside = (g_bin > near[0] + _CLIPPED_SD * sd) & (g_bin < near[1] - _CLIPPED_SD * sd)
    if free.all():
        inside[:] = True  # nothing was cut off
    if inside.sum() < 2:
        inside = v_bin > 0.0
    excess_sd = np.sqrt(8.0 * repeat / max(v.size, 1))
    g_bin, v_bin, sd_bin = g_bin[inside], v_bin[inside], sd_bin[inside]
    return _Bins(g_bin, v_bin, sd_bin, ratio / max(weight, 1.0), float(excess_sd))


def _fit(g: Float, v: Float, sd: Float) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Polynomial over the bins: of the lowest degree up to 2 whose next coefficient is not sure, positive in range."""
    middle, half = 0.5 * (g[0] + g[-1]), max(0.5 * (g[-1] - g[0]), 1e-9)
    u = (g - middle) / half
    chosen: tuple[Float, Float, float] | None = None
    for degree in range(min(3, len(g))):
        A = u[:, None] ** np.arange(degree + 1)
        weight = 1.0 / sd**2
        for _ in range(10):
            C = np.linalg.inv((A * weight[:, None]).T @ A)
            x = C @ (A * weight[:, None]).T @ v
            model = np.maximum(A @ x, 1e-3 * v.mean())
            error = (
                sd / np.maximum(v, 1e-12) * model
            )  # the model's own standard deviation, so that low bins have no undue weight
            t = np.abs(v - model) / error
            weight = np.where(t < 3.0, 1.0, 3.0 / np.maximum(t, 1e-12)) / error**2
        misfit = float(np.sqrt(np.mean(np.minimum(t, 1e6) ** 2)))
        C = C * max(misfit, 1.0) ** 2
        positive = (np.polynomial.polynomial.polyval(np.linspace(-1, 1, 33), x) > 0.0).all()
        sure = degree == 0 or abs(x[degree]) > _SURE * np.sqrt(C[degree, degree])
        if chosen is None or (sure and positive):
            chosen = x, C, misfit
    assert chosen is not None
    x, C, misfit = chosen
    # from u = (g - middle) / half to g
    T = np.zeros((3, 3))
    a, b = 1.0 / half, -middle / half
    T[0] = [1.0, b, b * b]
    T[1] = [0.0, a, 2.0 * a * b]
    T[2] = [0.0, 0.0, a * a]
    n = len(x)
    c = T[:, :n] @ x
    cov = T[:, :n] @ C @ T[:, :n].T
    s = np.sqrt(np.diag(cov))
    return (float(c[0]), float(c[1]), float(c[2])), (float(s[0]), float(s[1]), float(s[2])), misfit
