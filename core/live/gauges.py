"""Gauges that are read in every frame: values and uncertainties through a few weighted sums of points.

Each gauge is a function of a few sums L = W V over its points: V (m, 6) holds X Y Z U V W of the points, W (q, m) the
weights, which stay as long as the same points are valid. With J the function's derivative by L, an error of the points
changes a reading by ``sum_k v_k . dV_k``, v = J W; its own variance is ``sum_kl v_k S_k rho_kl S_l v_l``, with S the
roots of the points' covariances and rho the share of pixels that two subsets have in common, and its common factor
``sum_k v_k F_k``. These are the readings of :mod:`stereorig.core.gauge`, of which each is made for one field at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.gauge.reading import Reading, readings_of
from stereorig.core.gauge.sampling import sample
from stereorig.core.names import UNITS, GaugeKind
from stereorig.core.settings import StrainTensor
from stereorig.core.status import PointStatus
from stereorig.core.strain.surface import surface_frames
from stereorig.core.strain.tensors import pulls_of, strain_of, strain_slopes

_ENOUGH = 0.5
_MIN_POINTS = 3
_STRAIGHT = 1e-6
_SUMS, _QUANTITIES = 3, 6  # largest numbers for a gauge
_ABOUT = 2  # points on either side of a position that its cubics and their checks use


@dataclass(frozen=True, eq=False)
class LiveGauge:
    """A gauge of a live measurement.

    Attributes
    ----------
    name
        Its name.
    kind
        ``point``, ``extensometer`` or ``area``.
    ends_px
        (1, 2) position of a point, (2, 2) ends of an extensometer, in camera 1's reference image; None of an area.
    inside
        (r, c) True for the points of an area; None of the others.
    tensor
        Which strain an area has.
    """

    name: str
    kind: GaugeKind
    ends_px: Float | None = None
    inside: Bool | None = None
    tensor: StrainTensor = "green_lagrange"

    def points(self, x_px: Float, y_px: Float, spacing_px: float) -> Bool:
        """Return (r, c) True for the points of a grid that the gauge needs, those that check them included.

        Raises
        ------
        RegionError
            ``gauge_outside`` if there is none.
        """
        if self.inside is not None:
            needed = self.inside
        else:
            needed = np.zeros(x_px.shape, bool)
            for x, y in np.asarray(self.ends_px):
                reach = _ABOUT * spacing_px + 1e-9
                needed |= (np.abs(x_px - x) <= reach) & (np.abs(y_px - y) <= reach)
        if not needed.any():
            raise RegionError(
                f"No point of the region lies about the gauge {self.name}.",
                code="gauge_outside",
                remedy="Lay the gauge inside the region, in pixels of camera 1's reference image.",
            )
        return needed


@dataclass(frozen=True, eq=False)
class FrameReadings:
    """Readings of a gauge in one frame.

    Attributes
    ----------
    values
        Reading by quantity; empty if ``missing`` gives a reason.
    missing
        Empty, or the reason: the status of a point that it needs, ``cut``, ``occluded``, ``too_few_points``.
    """

    values: Mapping[str, Reading]
    missing: str = ""


@dataclass(frozen=True, eq=False)
class _Weights:
    """Weights (q, m) of points (m,), and the correlation (m, m) of their errors; or why there are none."""

    index: NDArray[np.int64]
    weight: Float
    correlation: csr_array
    missing: str = ""


@dataclass(frozen=True, eq=False)
class _Joined:
    """The gauges that can be read, as one: a row for each gauge and point that it uses.

    ``gauges`` in order, ``missing`` why the others have no values; ``index`` the points that any uses, ``place`` (m,) a
    row's point among these, ``gauge_of`` (m,) its gauge, ``first`` each gauge's first row, ``weight`` (m, 3) of the row
    in the gauge's sums, ``correlation`` (m, m).
    """

    gauges: Sequence[LiveGauge]
    missing: Mapping[str, str]
    index: NDArray[np.int64]
    place: NDArray[np.int64]
    gauge_of: NDArray[np.int64]
    first: NDArray[np.int64]
    weight: Float
    correlation: csr_array

    @staticmethod
    def of(gauges: Sequence[LiveGauge], weights: Sequence[_Weights]) -> _Joined:
        """Join the gauges that have weights."""
        missing = {gauge.name: one.missing for gauge, one in zip(gauges, weights, strict=True) if one.missing}
        there = [(gauge, one) for gauge, one in zip(gauges, weights, strict=True) if not one.missing]
        if not there:
            nothing = np.zeros(0, np.int64)
            return _Joined([], missing, *(nothing,) * 4, np.zeros((0, _SUMS)), csr_array((0, 0)))
        sizes = np.array([len(one.index) for _, one in there])
        index, place = np.unique(np.concatenate([one.index for _, one in there]), return_inverse=True)
        weight = np.zeros((len(place), _SUMS))
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        for begin, size, (_, one) in zip(first, sizes, there, strict=True):
            weight[begin : begin + size, : len(one.weight)] = one.weight.T
        correlation = csr_array(block_diag([one.correlation for _, one in there], format="csr"))
        gauge_of = np.repeat(np.arange(len(there)), sizes)
        return _Joined([gauge for gauge, _ in there], missing, index, place, gauge_of, first, weight, correlation)

    def sum_of(self, rows: Float) -> Float:
        """Return the sum (g, ...) of rows (m, ...) by gauge."""
        return np.asarray(np.add.reduceat(rows, self.first, axis=0))


@dataclass(eq=False)
class GaugeSet:
    """Gauges over the fields of one live measurement; weights are kept while the same points are valid.

    Attributes
    ----------
    gauges
        The gauges.
    subset_px
        Width of the subset.
    shape
        The reference's shape: an area is read while half of the points that it has there are valid.
    """

    gauges: Sequence[LiveGauge]
    subset_px: float
    shape: Field
    _joined: _Joined | None = field(default=None, init=False)
    _status: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8), init=False)
    _curved: bool = field(default=False, init=False)

    def needed(self, spacing_px: float) -> Bool:
        """Return (r, c) True for the points that any gauge needs; see :meth:`LiveGauge.points`."""
        masks = [gauge.points(self.shape.x_px, self.shape.y_px, spacing_px) for gauge in self.gauges]
        return np.asarray(np.any(masks, axis=0)) if masks else np.zeros(self.shape.shape, bool)

    def used(self, now: Field) -> Bool:
        """Return (r, c) True for the points whose numbers the gauges use in a field."""
        used = np.zeros(now.status.size, bool)
        used[self._prepare(now).index] = True
        return used.reshape(now.shape)

    def read(self, now: Field) -> dict[str, FrameReadings]:
        """Return the readings of every gauge in a displacement field, by name."""
        assert now.uvw_mm is not None
        joined, n = self._prepare(now), now.status.size
        found = {gauge.name: FrameReadings({}, joined.missing.get(gauge.name, "")) for gauge in self.gauges}
        if not joined.gauges:
            return found
        used, at = joined.index, joined.place
        values = np.concatenate([now.xyz_mm.reshape(n, 3)[used], now.uvw_mm.reshape(n, 3)[used]], axis=1)
        sums = joined.sum_of(joined.weight[:, :, None] * values[at][:, None, :])
        normals = joined.sum_of(now.normal_sys.reshape(n, 3)[used][at])
        numbers, slopes = _numbers(joined.gauges, sums, normals)
        # effect of each row's point on each quantity of its gauge: (rows, k, 6)
        v = np.einsum("mkqx,mq->mkx", slopes[joined.gauge_of], joined.weight)
        each = v @ roots_of(now.covariance.reshape(n, 6, 6)[used])[at]
        shared = (joined.correlation @ each.reshape(len(at), -1)).reshape(each.shape)
        own = joined.sum_of((each * shared).sum(axis=-1))
        rows = None
        if now.common is not None:
            rows = joined.sum_of(v @ now.common.reshape(n, 6, -1)[used][at])
        for k, gauge in enumerate(joined.gauges):
            many = len(UNITS[gauge.kind])
            common = None if rows is None else rows[k, :many]
            readings = readings_of(numbers[k, :many], own[k, :many], common, now.causes)
            found[gauge.name] = FrameReadings(dict(zip(UNITS[gauge.kind], readings, strict=True)))
        return found

    def _prepare(self, now: Field) -> _Joined:
        shared = SharedPixels.of(now, self.subset_px)
        known = self._joined
        if known is None or not np.array_equal(self._status, now.status) or self._curved != shared.curved:
            known = _Joined.of(self.gauges, [self._weights_of(gauge, now, shared) for gauge in self.gauges])
            self._joined, self._status, self._curved = known, now.status.copy(), shared.curved
        return known

    def _weights_of(self, gauge: LiveGauge, now: Field, shared: SharedPixels) -> _Weights:
        nothing = np.zeros(0, np.int64), np.zeros((0, 0)), csr_array((0, 0))
        if gauge.inside is not None:
            index, weight, missing = self._over_area(gauge.inside, now)
        else:
            assert gauge.ends_px is not None
            index, weight, missing = _at_positions(now, gauge.ends_px)
        if missing:
            return _Weights(*nothing, missing)
        at = np.stack([now.x_px.ravel()[index], now.y_px.ravel()[index]], axis=1)
        one, two = cKDTree(at).query_pairs(shared.reach_px, p=np.inf, output_type="ndarray").T
        share = shared.correlation(*(at[one] - at[two]).T)
        each = np.arange(len(index))
        both = np.concatenate([one, two, each]), np.concatenate([two, one, each])
        correlation = csr_array((np.concatenate([share, share, np.ones(len(index))]), both), shape=2 * each.shape)
        return _Weights(index, weight, correlation)

    def _over_area(self, inside: Bool, now: Field) -> tuple[NDArray[np.int64], Float, str]:
        """Weights of an area's mean, and of its slopes over column and row in px: a plane through its points."""
        index = np.flatnonzero((inside & now.valid).ravel())
        had = int((inside & self.shape.valid).sum())
        if len(index) < _ENOUGH * had:
            return index, np.zeros((0, 0)), "occluded"
        at = np.stack([now.x_px.ravel()[index], now.y_px.ravel()[index]], axis=1)
        at = at - at.mean(axis=0) if len(at) else at
        spread = np.linalg.svd(at, compute_uv=False) if len(index) >= _MIN_POINTS else np.zeros(2)
        if spread[1] <= _STRAIGHT * spread[0]:
            return index, np.zeros((0, 0)), "too_few_points"
        slopes = np.linalg.pinv(np.column_stack([np.ones(len(index)), at]))
        return index, slopes, ""


def _at_positions(now: Field, ends_px: Float) -> tuple[NDArray[np.int64], Float, str]:
    samples = sample(now, ends_px)
    missing = next((text for text in samples.missing if text), "")
    if missing:
        return np.zeros(0, np.int64), np.zeros((0, 0)), missing
    used = samples.weight != 0.0
    index = np.unique(samples.index[used])
    weight = np.zeros((len(ends_px), len(index)))
    for k in range(len(ends_px)):
        np.add.at(weight[k], np.searchsorted(index, samples.index[k][used[k]]), samples.weight[k][used[k]])
    return index, weight, ""


def _numbers(gauges: Sequence[LiveGauge], sums: Float, normals: Float) -> tuple[Float, Float]:
    """Return the gauges' numbers (g, k), and their derivatives (g, k, q, 6) over the sums (g, q, 6).

    Beyond a gauge's own they are zero. ``normals`` (g, 3) point away from camera 1.
    """
    numbers, slopes = np.zeros((len(gauges), _QUANTITIES)), np.zeros((len(gauges), _QUANTITIES, _SUMS, 6))
    slopes[:, :3, 0] = np.eye(6)[3:]
    numbers[:, :3] = sums[:, 0, 3:]
    lines = [k for k, gauge in enumerate(gauges) if gauge.kind == "extensometer"]
    if lines:
        slopes[lines] = 0.0
        numbers[lines, :5], slopes[lines, :5, :2] = _extensometers(sums[lines, :2])
    for tensor in {gauge.tensor for gauge in gauges if gauge.kind == "area"}:
        areas = [k for k, gauge in enumerate(gauges) if gauge.kind == "area" and gauge.tensor == tensor]
        of_motion, of_position = (np.swapaxes(sums[areas, 1:, some], 1, 2) for some in (slice(3, 6), slice(3)))
        frame = surface_frames(of_position, normals[areas])
        per_mm = np.asarray(np.linalg.inv(frame.swapaxes(1, 2) @ of_position), dtype=np.float64)
        gradient = of_motion @ per_mm
        strain = strain_of(frame, gradient, tensor)
        numbers[areas, 3:] = strain
        slopes[areas, 3:, 1:] = strain_slopes(pulls_of(frame, gradient, tensor), tensor, per_mm, strain)
    return numbers, slopes


def _extensometers(sums: Float) -> tuple[Float, Float]:
    """Numbers (n, 5) and derivatives (n, 5, 2, 6) of extensometers from their ends (n, 2, 6)."""
    along0 = sums[:, 1, :3] - sums[:, 0, :3]
    along = along0 + sums[:, 1, 3:] - sums[:, 0, 3:]
    length0, length = (np.linalg.norm(a, axis=1)[:, None, None] for a in (along0, along))
    d0, d = np.zeros((2, len(sums), 2, 6))
    d0[..., :3] = np.stack([-along0, along0], axis=1) / length0
    d[..., :3] = d[..., 3:] = np.stack([-along, along], axis=1) / length
    by_length0 = d / length0 - length / length0**2 * d0
    slopes = np.stack([d0, d, d - d0, by_length0, d / length - d0 / length0], axis=1)
    a, b = length0[:, 0, 0], length[:, 0, 0]
    return np.stack([a, b, b - a, b / a - 1.0, np.log(b / a)], axis=1), slopes


def status_counts(now: Field) -> dict[str, int]:
    """Return the number of points by status, of those that a live measurement has."""
    number, count = np.unique(now.status[now.status != PointStatus.MASKED], return_counts=True)
    return {PointStatus(int(s)).name.lower(): int(n) for s, n in zip(number, count, strict=True)}
