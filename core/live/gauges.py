"""Gauges that are read in every frame: values and uncertainties through a few weighted sums of points.

Each gauge is a function of a few sums L = W V over its points: V (m, 6) holds X Y Z U V W of the points, W (q, m) the
weights, which stay as long as the same points are valid. With J the function's derivative by L, an error of the points
changes a reading by ``sum_k v_k . dV_k``, v = J W; its own variance is ``sum_kl v_k S_k rho_kl S_l v_l``, with S the
roots of the points' covariances and rho the share of pixels that two subsets have in common, and its common factor
``sum_k v_k F_k``. These are the readings of :mod:`core.gauge`, of which each is made for one field at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from core.arrays import Bool, Float
from core.errors import RegionError
from core.field.points.result import Field
from core.field.points.shared_pixels import SharedPixels, roots_of
from core.gauge.reading import Reading, reading_of
from core.gauge.sampling import sample
from core.settings import StrainTensor
from core.status import PointStatus
from core.strain.surface import surface_frames
from core.strain.tensors import strain_of, strain_slopes

GaugeKind = Literal["point", "extensometer", "area"]
UNITS: Mapping[GaugeKind, Mapping[str, str]] = {
    "point": {"u_mm": "mm", "v_mm": "mm", "w_mm": "mm"},
    "extensometer": {"length0_mm": "mm", "length_mm": "mm", "elongation_mm": "mm", "strain": "1", "true_strain": "1"},
    "area": {"u_mm": "mm", "v_mm": "mm", "w_mm": "mm", "exx": "1", "eyy": "1", "exy": "1"},
}
"""The quantities of each kind, with their units."""

_ENOUGH = 0.5
_MIN_POINTS = 3
_STRAIGHT = 1e-6
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
class GaugeReadings:
    """Readings of a gauge in one frame.

    Attributes
    ----------
    values
        By quantity; empty where ``missing`` says why.
    missing
        Empty, or why there are none: the status of a point that it needs, ``cut``, ``occluded``, ``too_few_points``.
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
    _weights: list[_Weights] = field(default_factory=list, init=False)
    _status: NDArray[np.int8] | None = field(default=None, init=False)
    _curved: bool = field(default=False, init=False)

    def needed(self, spacing_px: float) -> Bool:
        """Return (r, c) True for the points that any gauge needs; see :meth:`LiveGauge.points`."""
        masks = [gauge.points(self.shape.x_px, self.shape.y_px, spacing_px) for gauge in self.gauges]
        return np.asarray(np.any(masks, axis=0)) if masks else np.zeros(self.shape.shape, bool)

    def used(self, now: Field) -> Bool:
        """Return (r, c) True for the points whose numbers the gauges use in a field."""
        self._prepare(now)
        used = np.zeros(now.status.size, bool)
        for weights in self._weights:
            used[weights.index] = True
        return used.reshape(now.shape)

    def read(self, now: Field) -> dict[str, GaugeReadings]:
        """Return the readings of every gauge in a displacement field, by name."""
        assert now.uvw_mm is not None
        used = np.flatnonzero(self.used(now).ravel())
        place = np.empty(now.status.size, np.int64)
        place[used] = np.arange(len(used))
        n = now.status.size
        values = np.concatenate([now.xyz_mm.reshape(n, 3)[used], now.uvw_mm.reshape(n, 3)[used]], axis=1)
        roots = roots_of(now.covariance.reshape(n, 6, 6)[used])
        common = None if now.common is None else now.common.reshape(n, 6, -1)[used]
        normals = now.normal_sys.reshape(n, 3)[used]
        found = {}
        for gauge, weights in zip(self.gauges, self._weights, strict=True):
            if weights.missing:
                found[gauge.name] = GaugeReadings({}, weights.missing)
                continue
            at = place[weights.index]
            numbers, slopes = _numbers(gauge, weights.weight @ values[at], normals[at].mean(axis=0))
            v = np.einsum("kqx,qm->kmx", slopes, weights.weight)
            each = np.einsum("kmx,mxy->mky", v, roots[at])
            shared = (weights.correlation @ each.reshape(len(at), -1)).reshape(each.shape)
            own = np.einsum("mky,mky->k", each, shared)
            rows = None if common is None else np.einsum("kmx,mxc->kc", v, common[at])
            found[gauge.name] = GaugeReadings(
                {
                    name: reading_of(
                        float(numbers[k]), float(own[k]), None, None if rows is None else rows[k], now.causes
                    )
                    for k, name in enumerate(UNITS[gauge.kind])
                }
            )
        return found

    def _prepare(self, now: Field) -> None:
        shared = SharedPixels.of(now, self.subset_px)
        if self._status is not None and np.array_equal(self._status, now.status) and self._curved == shared.curved:
            return
        self._weights = [self._weights_of(gauge, now, shared) for gauge in self.gauges]
        self._status, self._curved = now.status.copy(), shared.curved

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


def _numbers(gauge: LiveGauge, sums: Float, normal: Float) -> tuple[Float, Float]:
    """Return a gauge's numbers (k,), and their derivatives (k, q, 6) over the sums (q, 6)."""
    if gauge.kind == "point":
        return sums[0, 3:], np.eye(6)[3:, None, :]
    if gauge.kind == "extensometer":
        return _extensometer(sums)
    frame = surface_frames(sums[None, 1:, :3].swapaxes(1, 2), normal[None])
    per_mm = np.asarray(np.linalg.inv(frame.swapaxes(1, 2) @ sums[None, 1:, :3].swapaxes(1, 2)), dtype=np.float64)
    gradient = sums[None, 1:, 3:].swapaxes(1, 2) @ per_mm
    strain = strain_of(frame, gradient, gauge.tensor)
    slopes = np.zeros((6, 3, 6))
    slopes[:3, 0] = np.eye(6)[3:]
    slopes[3:, 1:] = strain_slopes(frame, gradient, gauge.tensor, per_mm, strain)[0]
    return np.concatenate([sums[0, 3:], strain[0]]), slopes


def _extensometer(sums: Float) -> tuple[Float, Float]:
    along0 = sums[1, :3] - sums[0, :3]
    along = along0 + sums[1, 3:] - sums[0, 3:]
    length0, length = float(np.linalg.norm(along0)), float(np.linalg.norm(along))
    d0, d = np.zeros((2, 6)), np.zeros((2, 6))
    d0[:, :3] = np.stack([-along0, along0]) / length0
    d[:, :3] = d[:, 3:] = np.stack([-along, along]) / length
    numbers = np.array([length0, length, length - length0, length / length0 - 1.0, np.log(length / length0)])
    slopes = np.stack([d0, d, d - d0, d / length0 - length / length0**2 * d0, d / length - d0 / length0])
    return numbers, slopes


def status_counts(now: Field) -> dict[str, int]:
    """Return the number of points by status, of those that a live measurement has."""
    number, count = np.unique(now.status[now.status != PointStatus.MASKED], return_counts=True)
    return {PointStatus(int(s)).name.lower(): int(n) for s, n in zip(number, count, strict=True)}
