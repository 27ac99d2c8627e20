"""A strain over all steps of a measurement, with the errors that are new at each step and those that steps share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.common.factor import Causes, joined
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import Alignment, aligned
from stereorig.core.gauge.area import points_within
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.reading import MISSING, Reading, reading_of
from stereorig.core.gauge.sampling import Samples, sample
from stereorig.core.names import ALL_CAUSES
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.variables import STRAIN_NAMES
from stereorig.server.results.gauges.frames import lay
from stereorig.server.results.gauges.request import PlaneAlignment

_Positions = tuple[tuple[float, float], ...]


class Ends(NamedTuple):
    """An extensometer between two positions of camera 1's reference image."""

    a_px: tuple[float, float]
    b_px: tuple[float, float]


class Mean(NamedTuple):
    """The mean of a component of strain, ``exx`` or ``eyy``, over a polygon; over the whole field without one.

    X runs along the image's rows, or from the first to the second of two positions.
    """

    component: str
    polygon_px: _Positions | None = None
    x_line_px: tuple[tuple[float, float], tuple[float, float]] | None = None


def corners_of(rectangle_px: tuple[float, float, float, float] | None) -> _Positions | None:
    """Return the corners of a rectangle x0, y0, x1, y1; None of none, for the whole field."""
    if rectangle_px is None:
        return None
    x0, y0, x1, y1 = rectangle_px
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


class Deflection(NamedTuple):
    """The deflection in mm of a beam's position against the straight line between two others, of its supports.

    Along the surface's normal, or in the surface across that line.
    """

    middle_px: tuple[float, float]
    a_px: tuple[float, float]
    b_px: tuple[float, float]
    normal: bool


#: engineering strain of a component of each tensor, and its derivative
_ENGINEERING: dict[str, Callable[[float], tuple[float, float]]] = {
    "green_lagrange": lambda e: (float(np.sqrt(1.0 + 2.0 * e)) - 1.0, 1.0 / float(np.sqrt(1.0 + 2.0 * e))),
    "hencky": lambda e: (float(np.expm1(e)), float(np.exp(e))),
    "infinitesimal": lambda e: (e, 1.0),
}


@dataclass(frozen=True, eq=False)
class History:
    """An engineering strain over n steps; the reference has zero strain without an error.

    Attributes
    ----------
    value
        (n,) strain, or deflection in mm; NaN where there is none.
    own
        (n,) standard deviation of the errors that are new at each step.
    shared
        By cause (n, k): what one standard deviation of each error that all steps share adds to the values. Columns of
        two histories of one measurement with equal cause and number belong to the same error, but for ``reference``.
    known
        False if a step's own uncertainty or the calibration's part is not known.
    """

    value: Float
    own: Float
    shared: dict[str, Float]
    known: bool

    def at(self, steps: Bool) -> History:
        """Return the history at some of its steps, (n,) True."""
        shared = {cause: columns[steps] for cause, columns in self.shared.items()}
        return History(self.value[steps], self.own[steps], shared, self.known)

    @property
    def whole(self) -> Float:
        """(n,) standard uncertainty of each value."""
        return np.asarray(np.sqrt(self.own**2 + sum((columns**2).sum(axis=1) for columns in self.shared.values())))


def history(files: Sequence[Path], gauge: Ends | Mean | Deflection) -> History:
    """Read a gauge in every step.

    Parameters
    ----------
    files
        Result files of one measurement, by step.
    gauge
        What to read.

    Raises
    ------
    RegionError
        ``gauge_outside``, ``gauge_unusable``.
    MeasurementError
        ``too_few_points`` for the surface's plane.
    InputError
        ``evaluation_needs`` if a displacement field has no strain; ``settings_missing``.
    """
    frame = None
    if isinstance(gauge, Mean):
        asked = PlaneAlignment(kind="plane", x_direction="image_rows", x_line_px=gauge.x_line_px)
        first = read_field(files[0])
        frame = lay(asked, first, shared_pixels(files[0], first))
    readings = [_reading(path, gauge, frame) for path in files]
    n = len(readings)
    moved = [k for k, one in enumerate(readings) if one is not None]
    known = [(k, one) for k, one in enumerate(readings) if one is not None and np.isfinite(one.value)]
    value, own, reference = np.zeros(n), np.zeros(n), np.zeros((n, 1))
    value[moved] = np.nan
    causes = [one.causes or Causes.unseparated(len(one.common)) for _, one in known if one.common is not None]
    every = reduce(joined, causes, Causes((), ()))
    factor = np.zeros((n, len(every.columns)))
    for k, one in known:
        value[k], own[k] = one.value, one.budget.matching if one.budget.matching is not None else np.nan
        reference[k] = one.budget.reference or 0.0
        if one.common is not None:
            factor[k] = (one.causes or Causes.unseparated(len(one.common))).aligned(one.common, every)
    columns = {str(c): factor[:, [k for k, name in enumerate(every.columns) if name == c]] for c in ALL_CAUSES}
    every_part: dict[str, Float] = {"reference": reference, **columns}
    shared = {cause: held for cause, held in every_part.items() if held.any()}
    complete = len(causes) == len(known) and all(one.budget.matching is not None for _, one in known)
    return History(value, own, shared, complete)


def shared_pixels(path: Path, field: Field) -> SharedPixels:
    """Return the correlation of a field's points; raises ``settings_missing`` without the subset's width."""
    subset = read_head(path).settings.get("subset_px")
    if not isinstance(subset, int | float):
        raise InputError(
            f"{path.name} does not state its subset.",
            code="settings_missing",
            remedy="Measure again with this program.",
        )
    return SharedPixels.of(field, float(subset))


def _reading(path: Path, gauge: Ends | Mean | Deflection, frame: Alignment | None) -> Reading | None:
    """Return an engineering strain of a step; None for a shape."""
    field = read_field(path)
    if field.uvw_mm is None:
        return None
    if isinstance(gauge, Mean):
        assert frame is not None
        return _mean(path, aligned(field, frame), gauge)
    if isinstance(gauge, Deflection):
        return _deflection(field, gauge, shared_pixels(path, field))
    return extensometer(field, gauge.a_px, gauge.b_px, shared=shared_pixels(path, field)).strain


def _deflection(field: Field, gauge: Deflection, shared: SharedPixels) -> Reading:
    samples = sample(field, np.array([gauge.middle_px, gauge.a_px, gauge.b_px]))
    assert field.uvw_mm is not None
    if any(samples.missing):
        return MISSING
    at, normal = samples.of(field.xyz_mm), samples.of(field.normal_sys).mean(axis=0)
    span = at[2] - at[1]
    share = float((at[0] - at[1]) @ span / (span @ span))
    along = normal if gauge.normal else np.cross(normal, span)
    slope = np.zeros((3, 6))
    slope[:, 3:] = np.outer([1.0, share - 1.0, -share], along / np.linalg.norm(along))
    pairs = np.indices((3, 3)).reshape(2, -1)

    def variance(of: Samples) -> float:
        each = of.covariance(shared, *pairs).reshape(3, 3, 6, 6)
        return float(np.einsum("ia,ijab,jb->", slope, each, slope))

    reference, common = samples.reference_alone(), samples.common()
    return reading_of(
        float(np.sum(slope[:, 3:] * samples.of(field.uvw_mm))),
        variance(samples),
        None if reference is None else variance(reference),
        None if common is None else np.einsum("ia,iak->k", slope, common),
        field.causes,
    )


def _mean(path: Path, field: Field, gauge: Mean) -> Reading:
    from stereorig.core.strain import surface_strain  # slow to load, and not every start needs it
    from stereorig.core.strain.mean import mean_strain_variance  # slow to load, and not every start needs it

    measured, axis = read_strain(path), STRAIN_NAMES.index(gauge.component)
    if measured is None:
        raise InputError(
            f"{path.name} has no variable {gauge.component!r}.",
            code="evaluation_needs",
            remedy="Switch strain on when it is measured, or give an extensometer.",
        )
    strain = surface_strain(field, measured.options, subset_px=measured.subset_px)
    inside = points_within(field, gauge.polygon_px) & strain.valid
    if not inside.any():
        return MISSING
    mean = float(strain.strain[..., axis][inside].mean())
    found = mean_strain_variance(field, strain.options, inside, subset_px=strain.subset_px)
    own, frozen, common, causes = found.of(axis)
    value, slope = _ENGINEERING[strain.options.tensor](mean)
    return reading_of(
        value,
        own * slope**2,
        None if frozen is None else frozen * slope**2,
        None if common is None else common * slope,
        causes,
    )
