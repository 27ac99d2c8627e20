"""Planes or quadratics in windows whose points an edge, a hole or a crack has left on one side.

There planes give the strain in the middle of the points left, off by its gradient times that middle's distance;
quadratics give it at the point, with several times the noise. The gradient is known better than either strain: it is
the derivative of the metric, from the second derivatives over the windows about the point, of which those farther from
the edge are nearly free of noise. So the planes' error is estimated, and the smaller total error taken. If planes are
kept, their remaining bias counts in the reported uncertainty.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.window import distinct_windows
from stereorig.core.settings import StrainTensor
from stereorig.core.strain.on_surface import OnSurface
from stereorig.core.strain.reduced import window_sums
from stereorig.core.strain.result import StrainStatus
from stereorig.core.strain.tensors import as_tensor
from stereorig.core.strain.window import Slopes


def raise_order(slopes: Slopes, surface: OnSurface, tensor: StrainTensor) -> tuple[Slopes, Float, Bool]:
    """Replace planes by quadratics where these have the smaller total error.

    Parameters
    ----------
    slopes
        Slopes from planes (order ``auto``); quadratics' weights replace planes' in ``reduced``.
    surface
        The same on the surface.
    tensor
        Which strain.

    Returns
    -------
    tuple
        The slopes; (r, c, 3) variance of exx, eyy, exy that the planes' bias adds, zero for quadratics and whole
        windows; (r, c) True for quadratics.
    """
    good = slopes.status == StrainStatus.OK
    number = np.cumsum(good).reshape(good.shape) - 1
    left, raised = np.zeros((*good.shape, 3)), np.zeros(good.shape, bool)
    slope, spread, moments = slopes.slope.copy(), slopes.spread.copy(), slopes.moments.copy()
    bending = _bending(slopes, tensor)
    for (rows, cols, weights), seen in zip(slopes.reduced, slopes.seen, strict=True):
        ok = np.flatnonzero(slopes.status[rows, cols] == StrainStatus.OK)
        if len(ok) == 0:
            continue
        r, c = rows[ok], cols[ok]
        at = number[r, c]
        kinds, which = distinct_windows(seen[ok])
        curved = slopes.windows.quadratics(r, c, kinds, which, weights[ok])
        steep, noise = _around(bending, r, c, kinds, which)
        per_mm = surface.per_mm[at]
        off = np.einsum("mak,mbk->mab", steep, curved.bent)
        off = np.swapaxes(per_mm, -1, -2) @ (0.5 * (off + np.swapaxes(off, -1, -2))) @ per_mm
        bias = as_tensor(np.stack([off[:, 0, 0], off[:, 1, 1], off[:, 0, 1]], axis=-1), surface.strain[at], tensor)
        bent = curved.bent
        own = _diagonal(surface.covariance(bent @ noise @ np.swapaxes(bent, -1, -2), tensor, at))
        square = np.maximum(bias**2 - own, 0.0)
        planes = _diagonal(surface.covariance(slopes.spread[r, c], tensor, at)) + square
        quadratics = _diagonal(surface.covariance(curved.spread, tensor, at))
        better = (curved.status == StrainStatus.OK) & (quadratics.sum(axis=1) < planes.sum(axis=1))
        left[r, c] = np.where(better[:, None], 0.0, square)
        r, c = r[better], c[better]
        raised[r, c] = True
        slope[r, c], spread[r, c], moments[r, c] = curved.slope[better], curved.spread[better], curved.moments[better]
        weights[ok[better]] = curved.weights[better]  # in place: a field's weights are its largest array
    return replace(slopes, slope=slope, spread=spread, moments=moments), left, raised


def _metric_gradients(slopes: Slopes, tensor: StrainTensor) -> Float:
    """(r, c, 2, 3) tangent a times second derivative k, of the deformed surface less the reference's; zero if unknown.

    Half the sum over a and b exchanged is the gradient of the Green-Lagrange strain in grid steps. A bend without
    strain gives zero, since second derivatives are then perpendicular to the tangents.
    """
    before, second = slopes.slope[..., :3, :], slopes.second[..., :3, :]
    now, second_now = before + slopes.slope[..., 3:, :], slopes.second[..., 3:, :]
    if tensor == "infinitesimal":
        out = np.swapaxes(before, -1, -2) @ (second_now - second)
    else:
        out = np.swapaxes(now, -1, -2) @ second_now - np.swapaxes(before, -1, -2) @ second
    return np.where(np.isfinite(out), out, 0.0)


def _bending(slopes: Slopes, tensor: StrainTensor) -> Float:
    """(r, c, 16) one, gradients (2, 3) and their spread (3, 3), times the certainty of the window about the point."""
    assert slopes.second_spread is not None
    noise, flat = slopes.second_spread, (*slopes.status.shape, -1)
    trace = np.trace(noise, axis1=-2, axis2=-1)
    known = (slopes.status == StrainStatus.OK) & (trace > 0.0)
    weight = np.where(known, 1.0 / np.where(known, trace, 1.0), 0.0)
    gradients = _metric_gradients(slopes, tensor).reshape(flat)
    out = np.concatenate([np.ones((*weight.shape, 1)), gradients, noise.reshape(flat)], axis=-1)
    out *= weight[..., None]
    return out


def _around(bending: Float, rows: np.ndarray, cols: np.ndarray, kinds: Bool, which: np.ndarray) -> tuple[Float, Float]:
    """Mean over the windows about the points seen, weighted by their certainty: gradients (m, 2, 3), spread (m, 3, 3).

    Neighbouring windows share most of their points, so that averaging is taken not to lessen the noise.
    """
    half = int(np.sqrt(kinds.shape[1])) // 2
    counted = kinds[:, None].astype(np.float64)
    out = window_sums(bending, rows, cols, which, counted, half, from_centre=False)[:, 0]
    out /= np.where(out[:, :1] > 0.0, out[:, :1], 1.0)
    return out[:, 1:7].reshape(-1, 2, 3), out[:, 7:].reshape(-1, 3, 3)


def _diagonal(covariance: Float) -> Float:
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1))
