"""Cluster-robust covariance of fitted points: the narrow function before the compiled kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.matching.arguments import (
    VisiblePixels,
    degree_of,
    given_to_kernels,
    own,
    points_of,
    run_kernel,
    starts_of,
)
from stereorig.core.matching.image import ImageData, prepare
from stereorig.core.matching.kernels.drivers import cluster_robust_points, cluster_robust_space
from stereorig.core.matching.options import MatchOptions


def cluster_robust_covariance(
    pair: StereoPair,
    images: Sequence[ArrayLike | ImageData],
    xy_px: ArrayLike,
    w: ArrayLike,
    G: ArrayLike | None,
    epipolar_px: ArrayLike,
    options: MatchOptions | None = None,
    visible: VisiblePixels | None = None,
) -> tuple[Float, Bool]:
    """Return the cluster-robust covariance of fitted points, from their residuals in blocks of the subset.

    See :func:`cluster_robust_covariances`, whose first result it is.
    """
    independent, _, known = cluster_robust_covariances(pair, images, xy_px, w, G, epipolar_px, options, visible)
    return independent, known


def cluster_robust_covariances(
    pair: StereoPair,
    images: Sequence[ArrayLike | ImageData],
    xy_px: ArrayLike,
    w: ArrayLike,
    G: ArrayLike | None,
    epipolar_px: ArrayLike,
    options: MatchOptions | None = None,
    visible: VisiblePixels | None = None,
) -> tuple[Float, Float, Bool]:
    """Return two cluster-robust covariances of fitted points: of independent blocks, and of correlated neighbours.

    Parameters
    ----------
    pair
        The calibrated cameras.
    images
        Camera 1's and camera 2's reference images and, for a motion, current images.
    xy_px
        (N, 2) points in camera 1's reference image.
    w, G, epipolar_px
        (N, 3 or 6), (N, 3, 3 or 6), (N,) as the fit gave them; G is None for a shape.
    options, visible
        Options and visible pixels of the fit.

    Returns
    -------
    independent, correlated
        (N, 2, 2) of (w0, epipolar offset), or (N, 5, 5) of (w0, G00, G10, G20, epipolar offset).
    known
        (N,) False for points without one: outside an image, or without texture.

    Raises
    ------
    InputError, ImageError
        If shapes or settings do not fit together.

    Notes
    -----
    A sandwich covariance with clustered errors: the sum over blocks of the outer products of their scores, between
    inverses of the normal equations. It holds for residuals of any origin that are correlated over less than a block;
    its own standard deviation at a single point is some 20 % (33 px) or 25 % (21 px) of a variance.

    The residual of an image by blur is the texture's second derivative. Multiplied by the first derivative it is a
    divergence: its sum over a block equals the flow through the block's border, into the next block. Such blocks nearly
    cancel one another; others, of residuals that are wide, add. So the second covariance has the products of
    neighbouring blocks too, with triangular weights. It has a fourth of the degrees of freedom, and is meant for means
    over points.

    References
    ----------
    Liang and Zeger, Biometrika 73 (1986), doi:10.1093/biomet/73.1.13; Newey and West, Econometrica 55 (1987),
    doi:10.2307/1913610; Conley, Journal of Econometrics 92 (1999), doi:10.1016/S0304-4076(98)00084-0
    """
    options = options or MatchOptions()
    prepared = [prepare(image, options.interpolation) for image in images]
    if len(prepared) not in (2, 4) or (len(prepared) == 4) != (G is not None):
        raise InputError(f"{len(prepared)} images do not fit to the unknowns.", code="shape_mismatch")
    xy, n = points_of(xy_px)
    degree, terms = degree_of(options)
    unknown_w = starts_of("w", w, (n,), terms)
    unknown_g = None if G is None else starts_of("G", G, (n, 3), terms)
    offsets = own(np.broadcast_to(np.asarray(epipolar_px, dtype=np.float64), (n,)))
    given = given_to_kernels(pair, prepared, xy, unknown_w, options, visible, G=unknown_g, epipolar_px=offsets)
    kind, q = ("shape", 2) if G is None else ("motion", 5)
    out = np.full((n, 2 * q * q), np.nan)
    status, _ = run_kernel(cluster_robust_points[kind][degree], cluster_robust_space[kind][degree], given, out)
    known: Bool = status == 0
    out[~known] = np.nan
    both = out.reshape(n, 2, q, q)
    return both[:, 0], both[:, 1], known
