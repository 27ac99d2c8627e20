"""The points in a ring about a tip: displacements in its frame, how subsets see a field, and the points' covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Bool, Float
from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of, steps_px
from stereorig.core.field.region.line_crossings import find_near
from stereorig.server.evaluations.crack.drawn import DrawnCrack

_MOST, _MOST_FITTED = 2500, 1500  # points: time and memory go with their square, that of a fit with the cube
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_P2 = -2.5  # weight of the second Legendre polynomials in a quadratic patch's value at its middle
_JITTER = 1e-9
_OF_POINTS = ("xy_mm", "uvw_mm", "sigma_w_mm", "at", "roots", "frozen", "common", "weights", "fitted")


class Spread(NamedTuple):
    """Joint uncertainty of m numbers.

    From the points' own noise (m, m), the reference pair's part of it, and the common factor (m, k); None if unknown.
    """

    own: Float
    frozen: Float | None
    common: Float | None

    def whole(self, excess: float) -> Float:
        """Return the covariance, the own part enlarged for a misfit by the factor ``excess`` of its uncertainty."""
        own = excess**2 * self.own
        return own if self.common is None else np.asarray(own + self.common @ self.common.T)


@dataclass(frozen=True, eq=False)
class Points:
    """n points about a tip, in the drawn tip's frame.

    Attributes
    ----------
    xy_mm, uvw_mm, sigma_w_mm
        (n, 2) positions in the plane, (n, 3) displacements without the rigid motion, and (n,) the third's uncertainty.
    at, correlation
        (n,) flat indices in the field's grid, and (n, n) correlation of the points' own errors.
    roots, frozen
        (n, 2, 2) roots of the covariance of the displacement in the plane, and of the reference pair's part of it, or
        None.
    common, causes
        (n, 2, k) common factor and causes of its columns; None if it is not known.
    nodes_mm, weights
        (q, 2) and (n, q): a measured displacement is that of the surface at the point and these nodes, so weighted.
    fitted, spacing_mm
        (n,) True at points whose subsets overlap by a half at most: the series is fitted to them; the points' spacing.
    """

    xy_mm: Float
    uvw_mm: Float
    sigma_w_mm: Float
    at: NDArray[np.int64]
    correlation: Float
    roots: Float
    frozen: Float | None
    common: Float | None
    causes: Causes | None
    nodes_mm: Float
    weights: Float
    fitted: Bool
    spacing_mm: float

    @property
    def uv_mm(self) -> Float:
        """(n, 2) displacements in the plane."""
        return self.uvw_mm[:, :2]

    @cached_property
    def _lower(self) -> Float:
        n = len(self.correlation)
        return np.asarray(cholesky(self.correlation + _JITTER * np.eye(n), lower=True))

    @cached_property
    def _unroot(self) -> Float:
        return np.asarray(np.linalg.inv(self.roots))

    def whitened(self, values: Float) -> Float:
        """Return (2 n, c) values (n, 2, c) whose own errors are independent, of variance 1."""
        each = (self._unroot @ values).reshape(len(values), -1)
        return np.asarray(solve_triangular(self._lower, each, lower=True)).reshape(2 * len(values), -1)

    def unwhitened(self, gains: Float) -> Float:
        """Return (m, n, 2): derivatives over the displacements, from those (m, 2 n) over whitened values."""
        n = len(self.at)
        columns = gains.reshape(len(gains), n, 2).transpose(1, 2, 0).reshape(n, -1)
        back = solve_triangular(self._lower, columns, lower=True, trans="T").reshape(n, 2, -1)
        return np.asarray((np.swapaxes(self._unroot, 1, 2) @ back).transpose(2, 0, 1))

    def spread(self, gains: Float) -> Spread:
        """Return the joint uncertainty of numbers whose derivatives over the displacements are ``gains`` (m, n, 2)."""

        def through(roots: Float) -> Float:
            each = np.einsum("mna,nab->bmn", gains, roots)
            return np.asarray(sum(part @ self.correlation @ part.T for part in each))

        frozen = None if self.frozen is None else through(self.frozen)
        common = None if self.common is None else np.einsum("mna,nak->mk", gains, self.common)
        return Spread(through(self.roots), frozen, common)

    def spread_of(self, operator: csr_array) -> Float:
        """Return the whole covariance (m, m) of numbers with the derivatives ``operator`` (m, 2 n)."""
        n = len(self.at)
        each = operator @ bsr_array((self.roots, np.arange(n), np.arange(n + 1)), shape=(2 * n, 2 * n)).tocsr()
        whole = sum(part @ (part @ self.correlation).T for part in (each[:, 0::2], each[:, 1::2]))
        if self.common is not None:
            shared = operator @ self.common.reshape(2 * n, -1)
            whole = whole + shared @ shared.T
        return np.asarray(whole)

    @cached_property
    def few(self) -> Points:
        """The points that the series is fitted to."""
        k = self.fitted
        kept = {name: held[k] for name in _OF_POINTS if (held := getattr(self, name)) is not None}
        return replace(self, correlation=self.correlation[np.ix_(k, k)], **kept)

    def turned(self, angle_rad: float) -> Points:
        """Return the points in a frame that is turned about the drawn tip."""
        c, s = np.cos(angle_rad), np.sin(angle_rad)
        R = np.array([[c, s], [-s, c]])
        uvw = np.concatenate([self.uv_mm @ R.T, self.uvw_mm[:, 2:]], axis=1)
        return replace(
            self,
            xy_mm=self.xy_mm @ R.T,
            uvw_mm=uvw,
            nodes_mm=self.nodes_mm @ R.T,
            roots=R @ self.roots,
            frozen=None if self.frozen is None else R @ self.frozen,
            common=None if self.common is None else R @ self.common,
        )

    def of_few(self, gains: Float) -> Float:
        """Return gains (m, n, 2) over all points from those over the fitted ones."""
        out = np.zeros((len(gains), len(self.at), 2))
        out[:, self.fitted] = gains
        return out


def points_about(field: Field, shared: SharedPixels, crack: DrawnCrack, tip_mm: Float) -> Points:
    """Return the points in the ring about a tip at ``tip_mm`` (2,) of the drawn one's frame.

    Points whose subset meets the crack are left out: its pixels move with two bodies.
    """
    used = _chosen(field, shared, crack, tip_mm)
    stride = max(1, int(np.ceil(np.sqrt(used.sum() / _MOST))))
    kept = np.zeros(field.shape, bool)
    kept[::stride, ::stride] = True
    rows, cols = np.nonzero(used & kept)
    step = min(steps_px(field)) * stride
    apart_by = int(np.ceil(max(0.5 * shared.subset_px / step, np.sqrt(len(rows) / _MOST_FITTED)) - 1e-9))
    few = stride * max(1, apart_by)
    assert field.uvw_mm is not None
    x = field.xyz_mm[rows, cols]
    back, R = _without_motion(x, field.uvw_mm[rows, cols])
    plane = crack.axes[:2]
    # dU' = (R' - 1) dX + R' dU
    slope = np.concatenate([plane @ (R.T - np.eye(3)), plane @ R.T], axis=1)
    covariance = field.covariance[rows, cols]
    frozen = field.frozen_covariance
    at_px = np.stack([field.x_px[rows, cols], field.y_px[rows, cols]], axis=-1)
    apart = at_px[:, None] - at_px[None]
    n_nodes = np.stack(np.meshgrid(_NODES, _NODES), axis=-1).reshape(-1, 2)
    even = np.outer(_WEIGHTS, _WEIGHTS).ravel() / 4.0
    curved = even * (1.0 + _P2 * (1.5 * n_nodes**2 - 0.5).sum(axis=1))
    degree = np.full(len(rows), 2 if shared.curved else 1)
    if field.patch_degree is not None:
        degree = field.patch_degree[rows, cols]
    depth = np.concatenate([crack.axes[2] @ (R.T - np.eye(3)), crack.axes[2] @ R.T])
    return Points(
        xy_mm=(x - crack.origin_mm) @ plane.T,
        uvw_mm=back @ crack.axes.T,
        sigma_w_mm=np.sqrt(np.einsum("a,nab,b->n", depth, field.total_covariance[rows, cols], depth)),
        at=np.asarray(rows * field.shape[1] + cols, dtype=np.int64),
        correlation=shared.correlation(apart[..., 0], apart[..., 1]),
        roots=roots_of(slope @ covariance @ slope.T),
        frozen=None if frozen is None else roots_of(slope @ frozen[rows, cols] @ slope.T),
        common=None if field.common is None else np.asarray(slope @ field.common[rows, cols], dtype=np.float64),
        causes=field.causes,
        nodes_mm=0.5 * shared.subset_px * n_nodes @ crack.mm_per_px.T,
        weights=np.where((degree == 2)[:, None], curved, even),
        fitted=(rows % few == 0) & (cols % few == 0),
        spacing_mm=step * crack.scale,
    )


def _chosen(field: Field, shared: SharedPixels, crack: DrawnCrack, tip_mm: Float) -> Bool:
    """Return (r, c) True at the points of the ring that are used."""
    away = (field.xyz_mm - crack.origin_mm) @ crack.axes[:2].T - tip_mm
    distance = np.hypot(away[..., 0], away[..., 1])
    used = field.valid & (distance >= crack.inner_mm) & (distance <= crack.outer_mm)
    line = np.concatenate([crack.line_px, crack.pixel(tip_mm)[None]])
    pieces = np.ascontiguousarray(np.concatenate([line[:-1], line[1:]], axis=1))
    xy = np.stack([field.x_px[used], field.y_px[used]], axis=-1)
    near = np.zeros(len(xy), bool)
    find_near(0, len(xy), xy, int(shared.subset_px), 0.5, pieces, np.zeros((1, 1), np.int64), near)
    used[used] = ~near
    return np.asarray(used)


def _without_motion(x: Float, moved: Float) -> tuple[Float, Float]:
    """Return displacements (n, 3) of a body that is moved back, and the rotation R that it had."""
    arm, now = x - x.mean(axis=0), x + moved - (x + moved).mean(axis=0)
    R = Rotation.align_vectors(now, arm)[0].as_matrix()
    return now @ R - arm, R
