"""Arguments, work spaces and results of the kernels: named tuples, which numba supports."""

from __future__ import annotations

from typing import Any, NamedTuple


class ReferenceImage(NamedTuple):
    """(rows, cols) float32 each: pixels, gradients along x and y, and weights, which may be empty."""

    pixels: Any
    grad_x: Any
    grad_y: Any
    weights: Any


class ComparedImage(NamedTuple):
    """Padded coefficients as one row, the image's rows and columns, and the padded row's length."""

    coefficients: Any
    rows: int
    cols: int
    stride: int


class Setting(NamedTuple):
    """Options and noise: the images' variances, or all one where any is unknown."""

    subset: int
    order: int
    max_iterations: int
    tolerance: float
    first_rate: float
    max_sigma: float
    max_step: float
    slope_noise: float
    slope_share: float
    variances: tuple[float, ...]
    known_noise: bool
    rigid: bool


class Warped(NamedTuple):
    """The compared images as they were interpolated before, at one predicted place for each pixel of the reference.

    ``values`` three (rows, cols) float32, of no rows if they were not. ``bends`` (n, 3, 2, 3): the prediction's terms
    of second order about each point, x^2, x y and y^2 of image k's position along x and y, px, for offsets over the
    subset's half width. ``memory`` (m, ``n_kept``) and ``number`` (n,), each point's row of it: what is the same in
    every step, the reference's sums and the first image's comparison; NaN where no step was measured before.
    """

    values: Any
    bends: Any
    memory: Any
    number: Any


class Given(NamedTuple):
    """Images, cameras, n points and settings.

    ``patches`` (k, subset, subset) uint8 are zero where a pixel does not count, ``which`` (n,) is the index of a
    point's, -1 = none. Images compared with the reference: camera 2's reference and, for a motion, both cameras'
    current images. ``xy`` (n, 2) px; ``w`` (n, M), ``G`` (n, 3, M) starts, or with ``e`` (n,) px the results whose
    covariance is computed. With images warped before, the starts with ``e`` are the prediction that they show.
    """

    reference: ReferenceImage
    patches: Any
    which: Any
    images: tuple[ComparedImage, ...]
    lens1: Any
    lens2: Any
    R: Any
    t: Any
    xy: Any
    w: Any
    G: Any
    e: Any
    warped: Warped
    setting: Setting


class ReferenceSpace(NamedTuple):
    """Work space of the reference subset, and results of ``set_up_reference``.

    Raw sums, a vector for the nodes; then node monomials (M, 16), the change of basis (M, M) from monomials of a
    pixel's position to monomials of its ray, the middle of the subset's pixels from the point and half its width (3,)
    px, the sum of each column (2 M,), of f times it (2 M,), and the Gram matrix (2 M, 2 M); gain and offset are
    projected out of the last two.
    """

    raw: Any
    node_work: Any
    powers: Any
    basis: Any
    middle: Any
    sum_g: Any
    sum_fg: Any
    gram: Any


class Subset(NamedTuple):
    """A point's subset in the reference.

    ``mean``: grey levels taken off it.

    ``inside``: True if it is inside the image and the lens model's domain; the point's ray ``xc, yc``, the weights' sum
    ``p``, the remaining mean of f, the sum of squares of f about it, the differences of neighbours relative to it (1
    for white noise), the number of pixels that count, and the grey level that is subtracted from an image before it is
    first compared: zero unless the mean is so large relative to the contrast that the sums would lose it.
    """

    inside: bool
    xc: float
    yc: float
    p: float
    offset: float
    f2: float
    white: float
    n_pixels: float
    first_shift: float
    mean: float


class WarpSpace(NamedTuple):
    """Work space of one comparison: the warp, positions of its nodes, and sums over the pixels."""

    warp: Any
    positions: Any
    sums: Any


class Equations(NamedTuple):
    """Normal equations and their parts; four elements for three images, since products take pairs.

    Weights (4, 4); effect of a unit of each unknown on an image's matrix; columns; the Gram matrix times them; the
    same, weighted; the normal equations, then their factor.
    """

    weights: Any
    block: Any
    columns: Any
    half: Any
    weighted: Any
    normal: Any


class WorkSpace(NamedTuple):
    """Work space of a thread for one point after another: kernels make no arrays."""

    ref: Any
    of_reference: ReferenceSpace
    warp: WarpSpace
    rhs: Any
    levels: Any
    M: Any
    equations: Equations
    moves: Any
    vectors: Any
    inverse: Any
    G: Any
    rotation: Any
    chain: Any
    work: Any


class ClusterRobustSpace(NamedTuple):
    """The fit's space and one block's pixels, the blocks' sums, and their effect on the unknowns."""

    fit: WorkSpace
    part: Any
    scores: Any
    pull: Any
    z: Any
    sums: Any


class FitKernels(NamedTuple):
    """A compiled fit and its cluster-robust covariance, of one point each, and the makers of their work spaces."""

    point: Any
    space: Any
    observed: Any
    cluster_robust_space: Any
