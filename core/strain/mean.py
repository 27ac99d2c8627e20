"""Standard uncertainty of the mean of a strain over an area.

Neighbouring strains share the points of their windows, and these the pixels of their subsets. The mean is one weighted
sum over the points: each point's weight is the sum over all windows of the area that hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.common.budget import Budget, budget_of
from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.field.region.window import window_offsets
from stereorig.core.strain.options import StrainOptions
from stereorig.core.strain.result import StrainStatus
from stereorig.core.strain.surface import surface_slopes
from stereorig.core.strain.tensors import strain_slopes
from stereorig.core.strain.window import Slopes, plane_weights


@dataclass(frozen=True)
class MeanStrainVariance:
    """Variances of the means of exx, eyy, exy over an area.

    Attributes
    ----------
    own
        (3,) variance from the points' own noise; NaN without strain.
    reference
        (3,) the reference pair's part of it; None if it is not known separately.
    common
        (3, k) common factor; None if it is not known.
    causes
        Causes of the factor's columns.
    """

    own: Float
    reference: Float | None = None
    common: Float | None = None
    causes: Causes | None = None

    @property
    def budgets(self) -> tuple[Budget, ...]:
        """The budgets of the three means."""
        return tuple(budget_of(*self.of(axis)) for axis in range(3))

    def of(self, axis: int) -> tuple[float, float | None, Float | None, Causes | None]:
        """Return one mean's own variance, the reference pair's part of it, the common factor (k,) and its causes."""
        return (
            float(self.own[axis]),
            None if self.reference is None else float(self.reference[axis]),
            None if self.common is None else self.common[axis],
            self.causes,
        )


def mean_strain_sigma(field: Field, options: StrainOptions, inside: Bool, *, subset_px: float) -> tuple[Float, Float]:
    """Return the standard uncertainties (3,) of the means of exx, eyy, exy over an area, and the calibration's part.

    NaN without strain; only the calibration's part is NaN if the field has no common factor. The parameters are those
    in :func:`mean_strain_variance`.
    """
    found = mean_strain_variance(field, options, inside, subset_px=subset_px)
    if found.common is None:
        return np.sqrt(found.own), np.full(3, np.nan)
    part = np.linalg.norm(found.common, axis=1)
    return np.asarray(np.hypot(np.sqrt(found.own), part)), np.asarray(part)


def mean_strain_variance(field: Field, options: StrainOptions, inside: Bool, *, subset_px: float) -> MeanStrainVariance:
    """Return the uncertainty of the means of exx, eyy, exy over an area; see :func:`mean_strain_variances`."""
    return mean_strain_variances(field, options, [inside], subset_px=subset_px)[0]


def mean_strain_variances(
    field: Field, options: StrainOptions, areas: Sequence[Bool], *, subset_px: float
) -> list[MeanStrainVariance]:
    """Return the uncertainty of the means of exx, eyy, exy over areas, by source.

    Parameters
    ----------
    field
        The displacement that the strain was computed from.
    options
        Options of its computation.
    areas
        (r, c) each.
    subset_px
        Width of the subset that the field was measured with.

    Notes
    -----
    Errors dX_k, dU_k of the points change the slopes of a window by ``d_a = sum_k c_ak (dX, dU)_k``, and its strain by
    ``sum_a D_a . d_a``. The mean's error is ``sum_k v_k . (dX, dU)_k`` with v the sum of D over the windows that hold
    point k, times their weights c; its variance is ``sum_kl v_k S_k rho_kl S_l v_l``, S the roots of the points'
    covariances. The bias that planes leave in one-sided windows (order ``auto``) may have the same sign at all points
    and is added in full. The common factor goes through the same weights: ``sum_k v_k . F_k``, squared.
    """
    shared = SharedPixels.of(field, subset_px)
    slopes, surface, left, _ = surface_slopes(field, options, shared)
    good = slopes.status == StrainStatus.OK
    by_slope = strain_slopes(surface.pulls, options.tensor, surface.per_mm, surface.strain)
    frozen = field.frozen_covariance
    there = field.valid[..., None, None]
    roots = roots_of(np.where(there, field.covariance, 0.0))
    roots_frozen = None if frozen is None else roots_of(np.where(there, frozen, 0.0))
    out = []
    for inside in areas:
        used = good & inside
        if not used.any():
            out.append(MeanStrainVariance(np.full(3, np.nan)))
            continue
        v = _through_windows(field, options, slopes, used, by_slope[used[good]])

        def noise(roots: Float, v: Float = v) -> Float:
            each = v @ roots
            return np.asarray(np.maximum(np.einsum("rcij,rcij->i", each, shared.summed(field, each)), 0.0))

        common = None
        if field.common is not None:
            common = np.einsum("rcij,rcjk->ik", v, np.where(there, field.common, 0.0))
        out.append(
            MeanStrainVariance(
                noise(roots) + np.sqrt(left[used]).mean(axis=0) ** 2,
                None if roots_frozen is None else noise(roots_frozen),
                common,
                field.causes,
            )
        )
    return out


def _through_windows(field: Field, options: StrainOptions, slopes: Slopes, used: Bool, by_slope: Float) -> Float:
    """(r, c, 3, 6): each point's weight in the mean strain over the points ``used``, zero at points without weight."""
    from scipy.signal import oaconvolve  # slow to load, and not every start needs it

    D = np.zeros((*field.shape, 3, 2, 6))
    D[used] = by_slope / len(by_slope)
    half = options.window // 2
    v = np.zeros((field.shape[0] + 2 * half, field.shape[1] + 2 * half, 3, 6))
    offsets, _ = window_offsets(half)
    for rows, cols, weights in slopes.reduced:
        given = np.einsum("miab,mak->mkib", D[rows, cols], weights)
        at = rows[:, None] + half + offsets[:, 0], cols[:, None] + half + offsets[:, 1]
        np.add.at(v, at, given)
        D[rows, cols] = 0.0
    for a, along in enumerate(plane_weights(half)):
        kernel = np.zeros((options.window, options.window))
        kernel[offsets[:, 0] + half, offsets[:, 1] + half] = along
        v += oaconvolve(D[..., a, :], kernel[:, :, None, None], mode="full", axes=(0, 1))
    v = v[half : half + field.shape[0], half : half + field.shape[1]]
    return np.where(field.valid[..., None, None], v, 0.0)
