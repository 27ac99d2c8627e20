"""Arguments, work space and results of the kernels: named tuples, which numba supports."""

from __future__ import annotations

from typing import Any, NamedTuple

from stereorig.core.matching.kernels.given import ComparedImage, ReferenceImage


class Lattice(NamedTuple):
    """Points of the ordinary field and vectors between them.

    Column and row of the first point, px; distance of points and of vectors, px; first column of vectors whose windows
    are inside the image, and the one after the last; points of the prediction beyond the field on each side.
    """

    x0: float
    y0: float
    spacing: float
    step: int
    first: int
    last: int
    rim: int


class DenseGiven(NamedTuple):
    """Images, cameras, prediction and settings.

    ``blocked`` (rows, cols) uint8 of camera 1's image, 1 where a pixel does not count, or empty. ``nodes``, ``seen``,
    ``cells``: see :class:`stereorig.core.field.points.prediction.Prediction`. ``state`` (r, c, 8) at the points: w0,
    G00, G10, G20, the epipolar offset; camera 2's normalised shift for a pixel across the epipolar line, x and y, and
    its pixels for a unit of w0. ``levels`` (1 + images,) grey levels that are taken off the images, so that sums keep
    their digits. ``variances``: of the images' noise at weight 1, or all one.
    """

    reference: ReferenceImage
    blocked: Any
    images: tuple[ComparedImage, ...]
    lens1: Any
    lens2: Any
    R: Any
    t: Any
    to_sys: Any
    lattice: Lattice
    nodes: Any
    seen: Any
    cells: Any
    state: Any
    levels: Any
    subset: int
    order: int
    variances: tuple[float, ...]


class DenseSpace(NamedTuple):
    """Work space of a thread: rows of pixels in a ring, sums of columns and windows, small matrices, one state."""

    ring: Any
    lines: Any
    tap: Any
    tx: Any
    ty: Any
    sums: Any
    windows: Any
    levels: Any
    weights: Any
    normal: Any
    small: Any
    local: Any


class DenseOut(NamedTuple):
    """Results over (rows, cols) vectors, NaN for vectors without one.

    ``values`` (..., 6) position and displacement, mm, system frame; ``covariance`` (..., 21) its upper triangle for
    noise of variance 1; ``epipolar`` px; ``zncc``, ``misfit`` (residual's squares per weight, reference grey levels),
    ``moved`` (px of each image) (..., images); ``sigma`` px for noise of variance 1; ``status`` int8.
    """

    values: Any
    covariance: Any
    epipolar: Any
    zncc: Any
    misfit: Any
    moved: Any
    sigma: Any
    status: Any
