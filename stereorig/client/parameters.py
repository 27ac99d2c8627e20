"""Parameters by their names, as types: the requests of the service.

Written by ``python -m tests.bench.documents.parameters`` from the request models, which have bounds and meanings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from stereorig.core.settings import Outline
    from stereorig.server.api.models.analyses import Region, StrainRequest
    from stereorig.server.results.gauges.request import (
        AreaGauge,
        ExtensometerGauge,
        GivenAlignment,
        LineGauge,
        PlaneAlignment,
        PointGauge,
        RigidRemoval,
        ThreeTwoOneAlignment,
    )


class OutlineParameters(TypedDict, total=False):
    """A closed outline: a rectangle, a polygon or a circle, in camera 1's reference image."""

    rectangle: Sequence[float] | None
    polygon: Sequence[Sequence[float]] | None
    circle: Sequence[float] | None


class RegionParameters(TypedDict, total=False):
    """Region of interest: one of rectangle, polygon and outlines, a mask if wanted, cracks and holes."""

    rectangle: Sequence[float] | None
    polygon: Sequence[Sequence[float]] | None
    outlines: Sequence[OutlineParameters | Outline]
    cracks: Sequence[Sequence[Sequence[float]]]
    holes: Sequence[Sequence[Sequence[float]]]
    mask_png_base64: str | None


class StrainParameters(TypedDict, total=False):
    """Strain over a virtual gauge, (window - 1) spacing_px + subset_px wide."""

    window: int
    order: Literal[1, 2, "auto"]
    tensor: Literal["green_lagrange", "infinitesimal", "hencky"]


class AnalysisParameters(TypedDict, total=False):
    """Analysis over a test's steps; a named recipe gives the settings that the request leaves out."""

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
    strain: StrainParameters | StrainRequest | None
    smoothing_window: int | None
    dense_step_px: int | None
    recipe: str | None
    kind: Literal["profile", "displacement"]
    calibration_id: str | None
    noise_id: str | None
    steps: Sequence[int] | None
    reference: int
    follow: bool
    label: str


class CalibrationParameters(TypedDict, total=False):
    """Plan of a calibration; the rig file gives the parts left out."""

    positions_mm: Sequence[float] | None
    held_out_mm: Sequence[float] | None
    frames: int | None
    localiser: Literal["profile", "paper"] | None
    label: str


class PointGaugeParameters(TypedDict, total=False):
    """Values at one position."""

    name: str | None
    xy_px: Sequence[float] | None
    xy_mm: Sequence[float] | None


class ExtensometerGaugeParameters(TypedDict, total=False):
    """A virtual extensometer."""

    name: str | None
    a_px: Sequence[float] | None
    b_px: Sequence[float] | None
    ends_mm: Sequence[Sequence[float]] | None


class LineGaugeParameters(TypedDict, total=False):
    """Values along a polyline."""

    name: str | None
    vertices_px: Sequence[Sequence[float]]
    count: int | None


class AreaGaugeParameters(TypedDict, total=False):
    """Statistics over a rectangle or polygon; over the whole field if neither is given."""

    name: str | None
    rectangle_px: Sequence[float] | None
    polygon_px: Sequence[Sequence[float]] | None


class PlaneAlignmentParameters(TypedDict, total=False):
    """Z = 0 in the best-fit plane of the reference's points in an area or the whole field."""

    rectangle_px: Sequence[float] | None
    polygon_px: Sequence[Sequence[float]] | None
    kind: Literal["plane"]
    x_direction: Sequence[float] | Literal["image_rows"]
    x_line_px: Sequence[Sequence[float]] | None


class ThreeTwoOneAlignmentParameters(TypedDict, total=False):
    """Three positions on the plane Z = 0, two on the X axis, one at X = 0."""

    kind: Literal["3-2-1"]
    positions_px: Sequence[Sequence[float]]


class GivenAlignmentParameters(TypedDict, total=False):
    """A frame that is written out."""

    kind: Literal["given"]
    rotation: Sequence[Sequence[float]]
    origin_mm: Sequence[float]


class RigidRemovalParameters(TypedDict, total=False):
    """Remove the best-fit rigid motion from every step, fitted over an area or the whole field."""

    rectangle_px: Sequence[float] | None
    polygon_px: Sequence[Sequence[float]] | None
    robust: bool


class GaugeParameters(TypedDict, total=False):
    """A set of gauges, read in every step."""

    k: float | None
    coverage: float | None
    points: Sequence[PointGaugeParameters | PointGauge]
    extensometers: Sequence[ExtensometerGaugeParameters | ExtensometerGauge]
    lines: Sequence[LineGaugeParameters | LineGauge]
    areas: Sequence[AreaGaugeParameters | AreaGauge]
    variables: Sequence[str] | None
    align: (
        PlaneAlignmentParameters
        | PlaneAlignment
        | ThreeTwoOneAlignmentParameters
        | ThreeTwoOneAlignment
        | GivenAlignmentParameters
        | GivenAlignment
        | None
    )
    remove_rigid: RigidRemovalParameters | RigidRemoval | None
    steps: Sequence[int] | None
    difference_from: int | None


class MoveParameters(TypedDict, total=False):
    """Targets of a move: axes by number, or cameras by their travel dZ."""

    positions_mm: Mapping[int, float] | Mapping[str, float] | None
    by_mm: Mapping[int, float] | Mapping[str, float] | None
    dz_mm: Mapping[Literal["cam1", "cam2"], float] | None


class StepParameters(TypedDict, total=False):
    """Capture one step, or a burst of them."""

    label: str
    load_n: float | None
    timestamp_utc: Any | None
    channels: Mapping[str, float]
    frames: int
    count: int
    interval_ms: float
