"""The covariance of fitted points as their residuals show it: the narrow function before the compiled kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.errors import InputError
from core.matching.arguments import (
    FEWEST_AT_ONCE,
    POINTS_AT_ONCE,
    VisiblePixels,
    degree_of,
    flat,
    lens_of,
    one_a_thread,
    own,
    points_of,
    reference_of,
    setting_of,
    starts_of,
    visible_of,
)
from core.matching.image import ImageData, prepare
from core.matching.kernels.drivers import observe_motion, observe_shape, observed_motion_space, observed_shape_space
from core.matching.options import MatchOptions
from core.threads import run_ranges


def observed_covariance(
    pair: StereoPair,
    images: Sequence[ArrayLike | ImageData],
    xy_px: ArrayLike,
    w: ArrayLike,
    G: ArrayLike | None,
    epipolar_px: ArrayLike,
    options: MatchOptions | None = None,
    visible: VisiblePixels | None = None,
) -> tuple[Float, Bool]:
    """Return the covariance of fitted points from how their residuals pull in blocks of the subset.

    Parameters
    ----------
    pair
        The calibrated cameras.
    images
        Camera 1's and camera 2's image at t0 and, for a motion, at t.
    xy_px
        (N, 2) points in camera 1 at t0.
    w, G, epipolar_px
        (N, 3 or 6), (N, 3, 3 or 6), (N,) as the fit gave them; G is None for a shape.
    options, visible
        Those of the fit.

    Returns
    -------
    covariance
        (N, 2, 2) of (w0, epipolar offset), or (N, 5, 5) of (w0, G00, G10, G20, epipolar offset).
    known
        (N,) False where a point has none: outside an image, or without texture.

    Raises
    ------
    InputError, ImageError
        If shapes or settings do not fit together.

    Notes
    -----
    A sandwich covariance with clustered errors: the sum over blocks of the outer products of their scores, between
    inverses of the normal equations. It holds for residuals of any origin that hang together over less than a block;
    of a single point it scatters itself by some 20 % (33 px) or 25 % (21 px) of a variance.
    """
    options = options or MatchOptions()
    prepared = [prepare(image, options.interpolation) for image in images]
    if len(prepared) not in (2, 4) or (len(prepared) == 4) != (G is not None):
        raise InputError(f"{len(prepared)} images do not fit to the unknowns.", code="shape_mismatch")
    xy, n = points_of(xy_px)
    degree, terms = degree_of(options)
    motion = G is not None
    unknown_w = starts_of("w", w, (n,), terms)
    unknown_g = np.zeros((n, 3, terms)) if G is None else starts_of("G", G, (n, 3), terms)
    offsets = own(np.broadcast_to(np.asarray(epipolar_px, dtype=np.float64), (n,)))
    q = 5 if motion else 2
    out, status = np.full((n, q * q), np.nan), np.ones(n, np.int8)
    seen = [flat(image) for image in prepared[1:]]
    pose = pair.cam2_from_cam1
    fixed = (
        reference_of(prepared[0]),
        visible_of(visible, n, options.subset_px),
        *(seen if motion else 3 * seen),
        lens_of(pair.cam1),
        lens_of(pair.cam2),
        own(pose.rotation),
        own(pose.translation_mm),
        xy,
        unknown_w,
        unknown_g,
        offsets,
        setting_of(options, prepared),
        options.patch == "rigid",
    )
    kernels, spaces = (observe_motion, observed_motion_space) if motion else (observe_shape, observed_shape_space)
    kernel, space = kernels[degree], one_a_thread(spaces[degree], options.subset_px)
    run_ranges(lambda first, last: kernel(first, last, *fixed, space(), out, status), n, POINTS_AT_ONCE, FEWEST_AT_ONCE)
    known: Bool = status == 0
    out[~known] = np.nan
    return out.reshape(n, q, q), known
