"""Strain of a measured and of a model's displacement, by the same windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.model.regions import ChiSquare, Tiles, holm
from stereorig.core.model.result import Compared
from stereorig.core.robust import chi_square_tail
from stereorig.core.strain.mean import mean_strain_variances
from stereorig.core.strain.options import StrainOptions
from stereorig.core.strain.result import StrainStatus
from stereorig.core.strain.surface import surface_strain


def compare_strain(
    measured: Field,
    model: Field,
    own: Float,
    columns: Float,
    tiles: Tiles,
    options: StrainOptions,
    *,
    subset_px: int,
    level: float,
) -> Compared | None:
    """Compare the strains of two displacements over the same points; None if no window has enough of them.

    Parameters
    ----------
    measured, model
        The field with its own and with the model's displacement; the model's is valid at points that are compared.
    own
        (r, c, 3, 3) covariance of the displacements' difference.
    columns
        (r, c, 3, q) its common columns.
    tiles
        The regions.
    options
        Options of the measured strain.
    subset_px
        Width of the subset.
    level
        Share of right models that may be refuted.

    Notes
    -----
    A strain's window is linear in the difference of both displacements, which is small: its uncertainty is propagated
    from that difference with the window's weights. Means over regions share points and calibration. The verdict of the
    whole field therefore takes each region's each component by itself, at a level that holds for all of them in any
    correlation (Holm).
    """
    covariance = np.zeros((*measured.shape, 6, 6))
    covariance[..., 3:, 3:] = own
    common = np.concatenate([np.zeros_like(columns), columns], axis=-2)
    one = replace(measured, status=model.status, covariance=covariance, common=common, causes=None, frozen=None)
    a, b = (surface_strain(f, options, subset_px=subset_px) for f in (one, replace(one, uvw_mm=model.uvw_mm)))
    both = (a.status == StrainStatus.OK) & (b.status == StrainStatus.OK) & (tiles.number >= 0)
    if a.raised is not None and b.raised is not None:
        both &= a.raised == b.raised  # the windows of the others are not the same
    if not both.any():
        return None
    assert a.common is not None
    variance = np.diagonal(a.covariance, axis1=-2, axis2=-1) + (a.common**2).sum(axis=-1)
    number = np.where(both, tiles.number, -1).astype(np.int32)
    difference = np.where(both[..., None], a.strain - b.strain, np.nan)
    held = np.unique(number[both])
    found = mean_strain_variances(one, options, [number == t for t in held], subset_px=subset_px)
    mean = np.full((tiles.count, 3), np.nan)
    sigma = np.full((tiles.count, 3), np.nan)
    for t, variances in zip(held, found, strict=True):
        part = 0.0 if variances.common is None else (variances.common**2).sum(axis=1)
        mean[t] = difference[number == t].mean(axis=0)
        sigma[t] = np.sqrt(variances.own + part)
    z2 = (mean / sigma) ** 2
    p = np.array([[chi_square_tail(float(v), 1) if np.isfinite(v) else np.nan for v in row] for row in z2])
    refuted = np.asarray(holm(p.ravel(), level).reshape(p.shape).any(axis=1))
    # verdict of each region by itself: the least probable of its three components, times three
    each = tuple(_least(z2[t], p[t]) for t in range(tiles.count))
    known = np.isfinite(p)
    k = int(np.nanargmin(np.where(known, p, 2.0)))
    overall = ChiSquare(float(z2.flat[k]), 1, float(min(1.0, p.flat[k] * known.sum())))
    shown = both[..., None]
    return Compared(
        measured=np.where(shown, a.strain, np.nan),
        model=np.where(shown, b.strain, np.nan),
        difference=difference,
        sigma=np.where(shown, np.sqrt(variance), np.nan),
        tile_difference=mean,
        tile_sigma=sigma,
        verdicts=each,
        refuted=refuted,
        overall=overall,
        accepted=not overall.probability <= level,
    )


def _least(z2: Float, p: Float) -> ChiSquare:
    if not np.isfinite(p).any():
        return ChiSquare(np.nan, 0, np.nan)
    k = int(np.nanargmin(p))
    return ChiSquare(float(z2[k]), 1, float(min(1.0, p[k] * np.isfinite(p).sum())))
