"""The points of a step whose images are warped once along its prediction, judged by points with fits of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.growth.grow import MAX_BATCH
from stereorig.core.field.growth.state import FieldInputs, GrowthState
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.warped_images import warp_to_prediction
from stereorig.core.progress import raise_if_cancelled

LEAST_POINTS = 1000
LARGEST_SPACING = 0.6
"""Fewer points, or points further apart (subsets), take less time by themselves: a warp's time is its pixels'."""
_MIN_JUDGES = 20
_FAR_PX = 0.1  # from the prediction; one step from there is no longer a point's own fit
_RMS_SIGMA, _WORST_SIGMA = 0.1, 0.4  # differences from a point's own fit, over its standard deviation


def fit_on_warped_images(
    inputs: FieldInputs,
    state: GrowthState,
    w: Float,
    G: Float,
    shape: Field,
    judges: NDArray[np.intp],
    index: NDArray[np.intp],
) -> NDArray[np.intp]:
    """Fit the points ``index`` on images warped once, and store their results; return those that are left.

    Parameters
    ----------
    inputs, state
        Of a motion; its points are changed in place.
    w, G
        (n, 3), (n, 3, 3) predicted unknowns, NaN where they are not known.
    shape
        The shape that was measured before.
    judges
        Points that are measured already. If their fits on the warped images differ from their own, no point is stored.
    index
        Points to be measured.
    """
    fitter = state.fitter
    known_w, options = inputs.known_w, fitter.options
    worth = len(index) >= LEAST_POINTS and inputs.grid.spacing_px <= LARGEST_SPACING * options.subset_px
    if known_w is None or not worth or inputs.options.blur is not None or options.patch != "affine":
        return index
    own = state.points.take(judges)
    if np.mean(fitter.far_from_start(inputs.xy_px[judges], own, w[judges], G[judges], _FAR_PX)) > 0.5:
        return index
    known = inputs.usable & np.isfinite(w).all(axis=1) & np.isfinite(G).all(axis=(1, 2))
    found = warp_to_prediction(fitter, inputs.grid, (known_w[:, 0], shape.epipolar_px.ravel()), w, G, known)
    if found is None:
        return index

    whole = found.whole if inputs.visibility is None else found.whole & inputs.visibility.whole

    def fit(some: NDArray[np.intp]) -> PointFits:
        return fitter.fit(inputs.xy_px[some], found.w[some], found.G[some], found.warped.take(some))

    inside = np.flatnonzero(whole[judges])
    if len(inside) < _MIN_JUDGES or not _agree(fit(judges[inside]), own.take(inside)):
        return index
    left, index = [index[~whole[index]]], index[whole[index]]
    for first in range(0, len(index), MAX_BATCH):
        raise_if_cancelled(inputs.cancel)
        some = index[first : first + MAX_BATCH]
        fits = fit(some)
        good = np.flatnonzero(fits.ok)
        state.points.put(some[good], fits.take(good))
        left.append(some[~fits.ok])
    return np.sort(np.concatenate(left))


def _agree(fits: PointFits, own: PointFits) -> bool:
    """Return True if fits on warped images are the points' own, as far as these are known."""
    both = fits.ok & own.ok
    if both.sum() < _MIN_JUDGES:
        return False
    sigma = np.sqrt(np.diagonal(own.covariance[both], axis1=1, axis2=2)[:, 1:4])
    share = (fits.G[both, :, 0] - own.G[both, :, 0]) / sigma
    return bool(np.sqrt(np.mean(share**2)) < _RMS_SIGMA and np.abs(share).max() < _WORST_SIGMA)
