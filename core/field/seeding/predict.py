"""Better starts for a step of a sequence, predicted from a sample of points.

A sample spread over the field is fitted from the previous step's values. The changes of its unknowns are fitted by a
smooth surface over the image, and all other points start from their previous values plus that. They then need half the
iterations; where the motion is not smooth, their starts are no worse than without the prediction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.starts import current_position
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight

_QUADRATIC_FROM, _LINEAR_FROM = 36, 12
_ROUNDS = 4
_WORTH = 0.5  # share of the sample's own motion that may be left unexplained


def predict(
    pair: StereoPair, xy_px: Float, G: Float, sample: NDArray[np.intp], w_current: Float, G_current: Float
) -> Float:
    """Return start values of G (n, 3, k): the previous step's, moved as the sample moved.

    Parameters
    ----------
    pair
        The calibrated cameras.
    xy_px
        (n, 2) all points.
    G
        (n, 3, k) at the previous step, NaN if it is not known.
    sample
        (m,) indices of the points that were fitted.
    w_current, G_current
        (m, 3 or more), (m, 3, k) their fitted unknowns.
    """
    if len(sample) < _LINEAR_FROM:
        return G
    terms = smooth_terms(xy_px)[:, : 6 if len(sample) >= _QUADRATIC_FROM else 3]
    design, change = terms[sample], G_current - G[sample]
    weight = np.ones(len(sample))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(design * root, change.reshape(len(sample), -1) * root, rcond=None)[0]
        left = np.linalg.norm(
            (change.reshape(len(sample), -1) - design @ solution).reshape(change.shape)[..., 0], axis=1
        )
        reach = BIWEIGHT_REACH * MAD_TO_SIGMA * max(float(np.median(left)), 1e-15)
        weight = biweight((left / reach) ** 2)
    moved = G + (terms @ solution).reshape(G.shape)
    seen = [_images(pair, w_current, g) for g in (G_current, G[sample], moved[sample])]
    before, after = (float(np.median(np.linalg.norm(seen[0] - s, axis=-1).max(axis=0))) for s in seen[1:])
    return moved if after < _WORTH * before else G


def _images(pair: StereoPair, w: Float, G: Float) -> Float:
    """Current image coordinates of the points in both cameras, (2, m, 2) px."""
    here = current_position(w, G)
    there = pair.cam2_from_cam1.apply(here)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack(
            [
                camera.lens.image_from_normalised(p[:, :2] / p[:, 2:]).xy
                for camera, p in ((pair.cam1, here), (pair.cam2, there))
            ]
        )
