"""Visibility of points that a reference lost, checked before a step is measured again against a later one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field

_TRIED = 24
_REACH_SUBSETS = 2
_SEEN = 0.5
"""Correlation from which a patch is seen again; by chance it stays below 0.4."""
_SHARE = 0.25


def still_visible(
    pair: StereoPair,
    before: tuple[MeasureImage, MeasureImage],
    now: tuple[MeasureImage, MeasureImage],
    previous: Field,
    field: Field,
    lost: Bool,
    *,
    subset_px: int,
) -> bool:
    """Return True unless a sample of the lost points is hidden: then no reference finds them again.

    Parameters
    ----------
    pair
        The calibrated cameras.
    before, now
        Both cameras' images of the step before and of this one.
    previous, field
        Their fields, of (r, c) points.
    lost
        (r, c) True for the points that the step before has and this one has not.
    subset_px
        Width of a subset.
    """
    index = np.flatnonzero(lost.ravel() & previous.valid.ravel())
    if len(index) == 0:
        return False
    some = index[np.unique(np.linspace(0, len(index) - 1, min(len(index), _TRIED)).astype(int))]
    both = np.flatnonzero((previous.valid & field.valid).ravel())
    seen = np.ones(len(some), bool)
    for camera, a, b in zip((pair.cam1, pair.cam2), before, now, strict=True):
        place = camera.project(_position(previous, some)).xy
        shift = np.zeros(2)
        if len(both):
            # in image coordinates, median over the points that both steps have
            shift = np.median(
                camera.project(_position(field, both)).xy - camera.project(_position(previous, both)).xy, axis=0
            )
        seen &= [_again(a, b, xy, xy + shift, subset_px) for xy in place]
    return bool(seen.mean() >= _SHARE)


def _position(field: Field, index: NDArray[np.intp]) -> Float:
    moved = 0.0 if field.uvw_mm is None else field.uvw_mm.reshape(-1, 3)[index]
    return np.asarray(field.xyz_mm.reshape(-1, 3)[index] + moved)


def _again(before: MeasureImage, now: MeasureImage, xy_px: Float, about_px: Float, subset_px: int) -> bool:
    half = subset_px  # twice a subset: chance stays low
    patch = _square(before, xy_px, half)
    window = _square(now, about_px, half + _REACH_SUBSETS * subset_px)
    if patch is None or window is None or min(window.shape) < len(patch) or len(patch) <= half:
        return False
    return bool(np.max(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED)) > _SEEN)


def _square(image: MeasureImage, xy_px: Float, half: int) -> NDArray[np.float32] | None:
    if not np.isfinite(xy_px).all():
        return None
    rows, cols = image.shape
    x, y = (round(float(v)) for v in xy_px)
    left, right, top, bottom = max(x - half, 0), min(x + half + 1, cols), max(y - half, 0), min(y + half + 1, rows)
    if right <= left or bottom <= top:
        return None
    return np.ascontiguousarray(image.pixels[top:bottom, left:right], dtype=np.float32)
