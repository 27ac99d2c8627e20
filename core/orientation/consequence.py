"""Consequence of a change of the relative orientation: in shape, position, displacement and strain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.change import ChangeSlopes
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.robust import spread_indices

_AT_MOST = 2000


@dataclass(frozen=True)
class Consequence:
    """Error of the points by a change that is not known; each with its standard deviation.

    Attributes
    ----------
    shape_um, shape_sigma_um
        Root mean square of the points' difference without a rigid motion.
    z_um, z_sigma_um
        Root mean square of Z's difference.
    displacement_um, displacement_sigma_um
        Root mean square of the difference: the displacement of a specimen at rest between images before and after.
    strain_microstrain, strain_sigma_microstrain
        Largest principal strain of that displacement over the points, its size.
    """

    shape_um: float
    shape_sigma_um: float
    z_um: float
    z_sigma_um: float
    displacement_um: float
    displacement_sigma_um: float
    strain_microstrain: float
    strain_sigma_microstrain: float

    def document(self) -> dict[str, Any]:
        """Return it as plain numbers."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class Consequences:
    """Error of points by any change: all of it is linear in the change.

    Attributes
    ----------
    moved, shape
        (n, 3, 5) mm per unit of a change: the points' differences, and these without a rigid motion.
    strain
        (2, 2, n, 5) of the difference, per unit of a change.
    """

    moved: Float
    shape: Float
    strain: Float

    @staticmethod
    def of(points: ChangeSlopes) -> Consequences | None:
        """Return the consequences for points, from their derivatives; None if fewer than ten can be triangulated."""
        count = len(points.rays[0].xyz_mm)
        if count == 0:
            return None
        some = np.unique(spread_indices(count, _AT_MOST))
        known = points if len(some) == count else points.at(some)
        xyz, slopes = known.pair.triangulate_rays(*known.rays).xyz_mm, known.position
        good = np.isfinite(xyz).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
        if good.sum() < 10:
            return None
        xyz, slopes = xyz[good], slopes[good]
        return Consequences(slopes, without_rigid_motion(xyz, slopes), _strain(xyz, slopes))

    def by(self, change: Float, covariance: Float) -> Consequence:
        """Return the consequence of a change (5,) with its covariance (5, 5)."""
        # in a narrow view only the prior determines some changes: this root accepts eigenvalues that rounding made
        # negative
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        um = 1e3
        return Consequence(
            shape_um=um * _rms(self.shape @ change),
            shape_sigma_um=um * _rms_over(self.shape @ root),
            z_um=um * _rms(self.moved[:, 2:] @ change),
            z_sigma_um=um * _rms_over(self.moved[:, 2:] @ root),
            displacement_um=um * _rms(self.moved @ change),
            displacement_sigma_um=um * _rms_over(self.moved @ root),
            strain_microstrain=1e6 * float(_largest_principal(self.strain @ change).max()),
            strain_sigma_microstrain=1e6
            * float(np.sqrt((_largest_principal(self.strain @ root) ** 2).sum(axis=-1)).max()),
        )


def consequence_of(pair: StereoPair, points: MatchedPoints, change: Float, covariance: Float) -> Consequence | None:
    """Return the error of points by a change.

    Parameters
    ----------
    pair, points
        The cameras and the points as matched.
    change, covariance
        (5,) and (5, 5), :data:`stereorig.core.orientation.change.CHANGE_NAMES`.

    Returns
    -------
    Consequence or None
        None if fewer than ten points can be triangulated.
    """
    found = Consequences.of(ChangeSlopes(pair, pair.rays(points.xy1_px, points.xy2_px)))
    return None if found is None else found.by(change, covariance)


def _largest_principal(strain: Float) -> Float:
    """(...) the principal strain of larger size of symmetric strains (2, 2, ...)."""
    xx, yy, xy = strain[0, 0], strain[1, 1], strain[0, 1]
    return np.asarray(np.abs(0.5 * (xx + yy)) + np.hypot(0.5 * (xx - yy), xy))


def without_rigid_motion(xyz_mm: Float, difference_mm: Float) -> Float:
    """Return differences (n, 3, k) of points (n, 3) without their best common rigid motion."""
    centred = xyz_mm - xyz_mm.mean(axis=0)
    motions = np.zeros((len(xyz_mm), 3, 6))
    motions[:, range(3), range(3)] = 1.0
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centred)
    flat, design = difference_mm.reshape(-1, difference_mm.shape[-1]), motions.reshape(-1, 6)
    return np.asarray((flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]).reshape(difference_mm.shape))


def _strain(xyz_mm: Float, difference_mm: Float) -> Float:
    """In-surface strain (2, 2, n, k) of differences (n, 3, k): both are quadratic over the best plane through it."""
    centred = xyz_mm - xyz_mm.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    ab = centred @ axes[:2].T
    spans = np.maximum(np.ptp(ab, axis=0), 1e-12)
    terms = smooth_terms(ab)
    x, y = terms[:, 1], terms[:, 2]
    zero, one = np.zeros(len(x)), np.ones(len(x))
    slopes = [
        np.column_stack([zero, one, zero, 2.0 * x, y, zero]) / spans[0],
        np.column_stack([zero, zero, one, zero, x, 2.0 * y]) / spans[1],
    ]
    surface = np.linalg.lstsq(terms, xyz_mm, rcond=None)[0]
    n, k = len(xyz_mm), difference_mm.shape[-1]
    shift = np.linalg.lstsq(terms, difference_mm.reshape(n, -1), rcond=None)[0].reshape(6, 3, k)
    tangents = np.stack([s @ surface for s in slopes], axis=-1)  # (n, 3, 2)
    gradient = np.stack([np.einsum("nt,tik->nik", s, shift) for s in slopes], axis=2)  # (n, 3, 2, k)
    # to an orthonormal frame of the tangent plane, from the tangents' triangular factor
    q, r = np.linalg.qr(tangents)
    inverse = np.linalg.inv(r)
    local = np.einsum("nia,nibk,nbc->nack", q, gradient, inverse)
    return np.moveaxis(0.5 * (local + np.swapaxes(local, 1, 2)), 0, 2)


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean((values**2).reshape(len(values), -1).sum(axis=1))))


def _rms_over(columns: Float) -> float:
    return float(np.sqrt(np.mean((columns**2).reshape(len(columns), -1).sum(axis=1))))
