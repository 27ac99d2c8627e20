"""The quantities of a planned measurement, each with its uncertainty by cause.

Read off synthetic fields by the measurement's own functions, once for each cause alone; the squares of the causes add
up to the total's square.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.field.region.window import window_offsets
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.names import BUDGET, BudgetName
from stereorig.core.plan.settings import PlannedMeasurement
from stereorig.core.plan.synthetic import PlannedField, Sizes, laid_about, planned_field
from stereorig.core.strain.tensors import pulls_of, strain_of, strain_slopes
from stereorig.core.strain.window import plane_weights

Of = Literal["point", "length", "mean", "strain"]
_AXES = "XYZ"
_MOST_ACROSS = 41  # points of an area's mean: more do not change the common part
_SEEN = "a camera does not see all of it"


@dataclass(frozen=True)
class PlannedQuantity:
    """The expected uncertainty of one quantity.

    Attributes
    ----------
    name
        ``X`` ``Y`` ``Z`` ``u`` ``v`` ``w`` ``exx`` ``eyy`` ``exy``, or ``length along X``, ``length along Y``.
    of
        A point of the middle, a length, the mean over an area, or a strain gauge about the middle.
    unit
        ``mm`` or ``1``.
    size_mm
        Length, side of the area or width of the gauge; None for a point.
    translation_mm
        Translation of the body since the reference; None for a quantity of the reference's shape.
    sigma
        Standard uncertainty (k = 1); None if it cannot be computed.
    budget
        The same by cause; empty if it cannot be computed.
    missing
        Reason why it cannot be computed; empty if it can.
    """

    name: str
    of: Of
    unit: Literal["mm", "1"]
    size_mm: float | None
    translation_mm: tuple[float, float, float] | None
    sigma: float | None
    budget: Mapping[BudgetName, float]
    missing: str = ""


def planned_quantities(
    pair: StereoPair, sizes: Sizes, source: ParameterCovariance, plan: PlannedMeasurement
) -> list[PlannedQuantity]:
    """Return the expected uncertainties of a measurement in the middle of the target.

    Parameters
    ----------
    pair, sizes
        The cameras and their images' (width, height).
    source
        Covariance of the cameras' parameters, by cause.
    plan
        The measurement.

    Raises
    ------
    FloatingPointError
        If the pixel next to the target's middle does not see its plane.
    """
    reader = _Reader(pair, sizes, source, plan)
    out = reader.of_shape()
    for size in plan.translations_mm:
        for axis in range(3):
            if size > 0.0 or axis == 0:
                out.extend(reader.of_motion(size, axis))
    return out


class _Reader:
    """Reads quantities off fields that share the plan."""

    def __init__(self, pair: StereoPair, sizes: Sizes, source: ParameterCovariance, plan: PlannedMeasurement) -> None:
        self.pair, self.sizes, self.source, self.plan = pair, sizes, source, plan
        self.shared = SharedPixels(plan.subset_px)
        self.middle_px = np.round(pair.cam1.project(np.zeros(3)).xy)
        # mm on the surface per px: the mean over both directions
        points = pair.cam1.back_project_to_plane(self.middle_px + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])).xyz_mm
        self.mm_per_px = float(np.sqrt(np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))))
        if not 0.0 < self.mm_per_px < np.inf:
            raise FloatingPointError("the target's plane has no size in a pixel about its middle")

    def of_shape(self) -> list[PlannedQuantity]:
        field = self._field(laid_about([self.middle_px], self.plan.spacing_px, 1))
        out = [self._of_point(field, name, k, None) for k, name in enumerate(_AXES)]
        for k in range(2):
            half = np.zeros(3)
            half[k] = 0.5 * self.plan.length_mm
            ends = [self.pair.cam1.project(sign * half).xy for sign in (-1.0, 1.0)]
            out.append(self._length(ends, f"length along {_AXES[k]}"))
        return out

    def of_motion(self, size_mm: float, axis: int) -> list[PlannedQuantity]:
        moved = [0.0, 0.0, 0.0]
        moved[axis] = size_mm
        motion = (moved[0], moved[1], moved[2])
        plan = self.plan
        names = ("u", "v", "w") if size_mm == 0.0 else ("uvw"[axis],)
        point = self._field(laid_about([self.middle_px], plan.spacing_px, 1), motion)
        out = [self._of_point(point, name, 3 + "uvw".index(name), motion) for name in names]
        # enough points over the area: with the planned spacing, or 41 across it
        across_px = plan.area_mm / self.mm_per_px
        step = max(plan.spacing_px, int(np.ceil(across_px / (_MOST_ACROSS - 1))))
        area = self._field(laid_about([self.middle_px], step, max(int(0.5 * across_px / step), 1)), motion)
        out.extend(self._mean(area, name, 3 + "uvw".index(name), motion) for name in names)
        half = plan.strain_window // 2
        window = self._field(laid_about([self.middle_px], plan.spacing_px, half), motion)
        return [*out, *self._strain(window, half, motion)]

    def _field(
        self, grid: tuple[Float, Float, np.ndarray], motion: tuple[float, float, float] | None = None
    ) -> PlannedField:
        return planned_field(self.pair, self.sizes, self.plan, grid, motion)

    def _budget(self, planned: PlannedField, read: Callable[[Field], Float]) -> Float:
        """(causes, q) standard uncertainties of q numbers that ``read`` gives for a field, by cause."""
        fields: dict[BudgetName, Field] = {
            "matching": planned.of_noise(planned.matching),
            "reference": planned.of_noise(planned.reference),
        }
        for cause, field in planned.of_causes(self.source).items():
            fields[cause] = field
        none = np.zeros_like(read(fields["matching"]))
        return np.stack([read(fields[cause]) if cause in fields else none for cause in BUDGET])

    def _of_point(
        self, planned: PlannedField, name: str, k: int, motion: tuple[float, float, float] | None
    ) -> PlannedQuantity:
        row, column = (int(v[0]) for v in np.nonzero(self._middle(planned.field)))
        if not planned.field.valid[row, column]:
            return _missing(name, "point", "mm", None, motion)
        found = self._budget(planned, lambda field: field.sigma_mm[row, column, k : k + 1])
        return _quantity(name, "point", "mm", None, motion, found[:, 0])

    def _length(self, ends_px: Sequence[Float], name: str) -> PlannedQuantity:
        size = self.plan.length_mm
        planned = self._field(laid_about(ends_px, self.plan.spacing_px, 1))

        def read(field: Field) -> Float:
            return np.array([extensometer(field, ends_px[0], ends_px[1], shared=self.shared).length0_mm.sigma])

        missing = extensometer(planned.field, ends_px[0], ends_px[1], shared=self.shared).missing
        if missing:
            return _missing(name, "length", "mm", size, None)
        return _quantity(name, "length", "mm", size, None, self._budget(planned, read)[:, 0])

    def _mean(self, planned: PlannedField, name: str, k: int, motion: tuple[float, float, float]) -> PlannedQuantity:
        size = self.plan.area_mm
        if not planned.field.valid.all():
            return _missing(name, "mean", "mm", size, motion)
        assert planned.field.uvw_mm is not None
        values = planned.field.uvw_mm[..., k - 3]
        inside = np.ones(planned.field.shape, bool)

        def read(field: Field) -> Float:
            common = None if field.common is None else field.common[..., k, :]
            own = np.sqrt(field.covariance[..., k, k])
            found = area_statistics(field, values, own, inside, shared=self.shared, common=common)
            return np.array([found.mean_sigma])

        return _quantity(name, "mean", "mm", size, motion, self._budget(planned, read)[:, 0])

    def _strain(self, planned: PlannedField, half: int, motion: tuple[float, float, float]) -> list[PlannedQuantity]:
        names = ("exx", "eyy", "exy")
        size = (2 * half * self.plan.spacing_px + self.plan.subset_px) * self.mm_per_px
        # the grid has a row and a column more than the window
        window = slice(0, 2 * half + 1)
        if not planned.field.valid[window, window].all():
            return [_missing(name, "strain", "1", size, motion) for name in names]
        found = self._budget(planned, lambda field: _strain_sigma(field, half, self.shared))
        return [_quantity(n, "strain", "1", size, motion, found[:, k]) for k, n in enumerate(names)]

    def _middle(self, field: Field) -> np.ndarray:
        return np.asarray((field.x_px == self.middle_px[0]) & (field.y_px == self.middle_px[1]))


def _strain_sigma(field: Field, half: int, shared: SharedPixels) -> Float:
    """(3,) standard uncertainties of the Green-Lagrange strain in the middle of a whole window."""
    assert field.uvw_mm is not None
    side = 2 * half + 1
    offsets, _ = window_offsets(half)
    at = offsets[:, 0] + half, offsets[:, 1] + half
    weights = plane_weights(half)
    values = np.concatenate([field.xyz_mm, field.uvw_mm], axis=-1)[at]
    slope = np.einsum("an,ni->ia", weights, values - values.mean(axis=0))
    frame = tangent_frames(field.normal_sys[half, half][None])[..., :2]
    per_mm = np.linalg.inv(np.swapaxes(frame, -1, -2) @ slope[None, :3])
    gradient = slope[None, 3:] @ per_mm
    strain = strain_of(frame, gradient, "green_lagrange")
    D = strain_slopes(pulls_of(frame, gradient, "green_lagrange"), "green_lagrange", per_mm, strain)[0]
    v = np.zeros((*field.shape, 3, 6))
    v[at] = np.einsum("iab,an->nib", D, weights)
    window = (slice(0, side), slice(0, side))
    if field.common is not None:
        return np.asarray(np.linalg.norm(np.einsum("rcij,rcjk->ik", v[window], field.common[window]), axis=1))
    each = np.zeros_like(v)
    each[window] = v[window] @ roots_of(field.covariance[window])
    return np.asarray(np.sqrt(np.maximum(np.einsum("rcij,rcij->i", each, shared.summed(field, each)), 0.0)))


def _quantity(
    name: str,
    of: Of,
    unit: Literal["mm", "1"],
    size_mm: float | None,
    motion: tuple[float, float, float] | None,
    sigmas: Float,
) -> PlannedQuantity:
    budget: dict[BudgetName, float] = dict(zip(BUDGET, sigmas.tolist(), strict=True))
    return PlannedQuantity(name, of, unit, size_mm, motion, float(np.linalg.norm(sigmas)), budget)


def _missing(
    name: str, of: Of, unit: Literal["mm", "1"], size_mm: float | None, motion: tuple[float, float, float] | None
) -> PlannedQuantity:
    return PlannedQuantity(name, of, unit, size_mm, motion, None, {}, _SEEN)
