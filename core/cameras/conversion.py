"""Conversion of lens models: exact for models with the same terms, else the best fit and its residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.lens import LensModel, OpenCVLens, SeidelLens
from stereorig.core.errors import CalibrationError

_ACROSS = 41  # positions across the image, each way
_STEPS = 30
_HALVINGS = 30
_SETTLED_PX = 1e-11


@dataclass(frozen=True)
class LensFit:
    """A lens converted to another model.

    Attributes
    ----------
    lens
        The fitted model.
    rms_px, max_px
        Differences of both models over the whole image.
    pixels_with_ray
        Share of the image where the original has a ray; elsewhere there is no fit.
    """

    lens: LensModel
    rms_px: float
    max_px: float
    pixels_with_ray: float


def image_positions(image_size_px: tuple[int, int]) -> Float:
    """Return a grid of positions (n, 2) over an image (width, height), its corners included."""
    width, height = image_size_px
    x, y = np.meshgrid(np.linspace(-0.5, width - 0.5, _ACROSS), np.linspace(-0.5, height - 0.5, _ACROSS))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def fit_opencv(
    lens: LensModel,
    image_size_px: tuple[int, int],
    *,
    skew: bool = True,
    tangential: bool = True,
    rational: bool = False,
) -> LensFit:
    """Fit OpenCV's model to a lens.

    Parameters
    ----------
    lens
        Any model.
    image_size_px
        (width, height) over which they are to agree.
    skew, tangential
        True if the model has a skew, and p1 and p2; without them the other terms approximate them.
    rational
        True if the model has k4, k5 and k6, which a lens then keeps; without them k1, k2 and k3 approximate them.

    Raises
    ------
    CalibrationError
        ``lens_unfittable`` if most of the image has no ray, or the fit does not settle.
    """
    if isinstance(lens, SeidelLens):
        # x / (1 + k r^2) = x (1 - k r^2 + ...)
        k = lens.kappa_per_px2 * lens.phd_px**2
        start = OpenCVLens(
            lens.phd_px, lens.phd_px * lens.aspect, lens.cx_px, lens.cy_px, 0.0, -k, k**2, 0.0, 0.0, -(k**3)
        )
    elif isinstance(lens, OpenCVLens):
        start = replace(lens, skew_px=lens.skew_px if skew else 0.0)
        start = start if tangential else replace(start, p1=0.0, p2=0.0)
        if lens.is_rational and not rational:
            # a series in r^2 may diverge inside the image; without k1, k2 and k3 every point is in the domain
            start = replace(start, k1=0.0, k2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
        if start == lens:
            return LensFit(lens, 0.0, 0.0, _rays(lens, image_size_px)[2])
    else:
        raise TypeError(f"a {type(lens).__name__} cannot be fitted")
    fixed = {"k4", "k5", "k6", *(() if skew else ("skew_px",)), *(() if tangential else ("p1", "p2"))}
    if isinstance(lens, SeidelLens):
        fixed |= {"skew_px", "p1", "p2"}  # it is symmetric about its centre: they stay zero
    return _fit(lens, start, [n for n in start.parameter_names if n not in fixed], image_size_px)


def fit_seidel(lens: LensModel, image_size_px: tuple[int, int]) -> LensFit:
    """Fit the paper's five parameters to a lens, see :func:`fit_opencv`."""
    if isinstance(lens, SeidelLens):
        return LensFit(lens, 0.0, 0.0, _rays(lens, image_size_px)[2])
    if not isinstance(lens, OpenCVLens):
        raise TypeError(f"a {type(lens).__name__} cannot be fitted")
    start = SeidelLens(lens.fx_px, lens.cx_px, lens.cy_px, (lens.k4 - lens.k1) / lens.fx_px**2, lens.fy_px / lens.fx_px)
    return _fit(lens, start, start.parameter_names, image_size_px)


def _rays(lens: LensModel, image_size_px: tuple[int, int]) -> tuple[Float, Float, float]:
    xy = image_positions(image_size_px)
    rays = lens.normalised_from_image(xy)
    share = float(rays.valid.mean())
    if share < 0.5:
        raise CalibrationError(
            f"Only {share:.0%} of the image has a ray: the lens polynomial folds back inside it.",
            code="lens_unfittable",
            remedy="Check the calibration and the image size.",
        )
    return rays.xy[rays.valid], xy[rays.valid], share


def _fit(
    lens: LensModel, start: OpenCVLens | SeidelLens, free: Sequence[str], image_size_px: tuple[int, int]
) -> LensFit:
    normalised, xy, share = _rays(lens, image_size_px)
    columns = [start.parameter_names.index(name) for name in free]
    fitted: Any = start  # the order of both is irrelevant here
    for _ in range(_STEPS):
        mapped = fitted.image_from_normalised(normalised)
        jacobian = fitted.parameter_jacobian(normalised)[..., columns]
        residual = np.where(mapped.valid[:, None], xy - mapped.xy, 0.0).ravel()
        jacobian = np.where(mapped.valid[:, None, None], jacobian, 0.0).reshape(-1, len(columns))
        scale = np.maximum(np.sqrt((jacobian**2).sum(axis=0)), 1e-300)  # columns differ by many powers of ten
        step = np.linalg.lstsq(jacobian / scale, residual, rcond=1e-14)[0] / scale
        for _ in range(_HALVINGS):
            moved = replace(fitted, **{n: float(getattr(fitted, n) + d) for n, d in zip(free, step, strict=True)})
            if moved.image_from_normalised(normalised).valid.sum() >= mapped.valid.sum():
                break
            step = 0.5 * step  # it would fold back inside the image
        fitted = moved
        if not np.isfinite(step).all() or np.abs(jacobian @ step).max() < _SETTLED_PX:
            break
    mapped = fitted.image_from_normalised(normalised)
    if not mapped.valid.all():
        raise CalibrationError(
            "The lens model cannot be fitted over the whole image.",
            code="lens_unfittable",
            remedy="Choose a format with more lens terms.",
        )
    off = np.linalg.norm(mapped.xy - xy, axis=1)
    return LensFit(fitted, float(np.sqrt(np.mean(off**2))), float(off.max()), share)
