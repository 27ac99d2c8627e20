"""Parameters by their names, as types: a measurement in memory.

Written by ``python -m tests.bench.documents.parameters`` from the request models, which have bounds and meanings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, TypedDict

if TYPE_CHECKING:
    from stereorig.core.settings import Outline, Region, StrainSettings


class OutlineParameters(TypedDict, total=False):
    """A closed outline: a rectangle, a polygon or a circle, in camera 1's reference image."""

    rectangle: Sequence[float] | None
    polygon: Sequence[Sequence[float]] | None
    circle: Sequence[float] | None


class RegionParameters(TypedDict, total=False):
    """Region of interest: a rectangle, a polygon or several outlines, or a mask alone; cracks and holes."""

    rectangle: Sequence[float] | None
    polygon: Sequence[Sequence[float]] | None
    outlines: Sequence[OutlineParameters | Outline]
    cracks: Sequence[Sequence[Sequence[float]]]
    holes: Sequence[Sequence[Sequence[float]]]


class MeasurementParameters(TypedDict, total=False):
    """Settings of a measurement, except its images and its calibration."""

    region: RegionParameters | Region
    subset_px: int
    spacing_px: int
    patch: Literal["affine", "rigid", "quadratic", "auto"]
    interpolation: Literal["cubic", "quintic"]
    prefilter_px: float
    max_sigma_px: float
    keep_rejected: bool
    seeds: Sequence[Sequence[float]] | None
    seeds_cam2: Sequence[Sequence[float] | None] | None
    reference_update: Literal["never", "auto", "always"]
    start_from: Literal["previous", "reference"]
    side_by_side: Literal["auto", "never"]
    pattern: Literal["surface", "projected"]
    strain: StrainParameters | StrainSettings | None
    smoothing_window: int | None
    dense_step_px: int | None


class StrainParameters(TypedDict, total=False):
    """Strain over a virtual gauge, (window - 1) spacing_px + subset_px wide."""

    window: int
    order: Literal[1, 2, "auto"]
    tensor: Literal["green_lagrange", "infinitesimal", "hencky"]
