"""The settings of an analysis that a report states, as its result files have them."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.formats.records import Record


class ReportedOutline(Record):
    """One outline of a region, px of camera 1's reference image."""

    rectangle: tuple[float, float, float, float] | None = None
    polygon: list[tuple[float, float]] | None = None
    circle: tuple[float, float, float] | None = None


class ReportedRegion(ReportedOutline):
    """Region of the points, px of camera 1's reference image."""

    outlines: list[ReportedOutline] = Field(default=[])
    cracks: list[object] | None = None
    holes: list[object] | None = None
    mask: object = None


class ReportedNoise(Record):
    """A camera's noise model: variance by powers of the grey level."""

    coefficients: list[float]
    frames: int


class NoiseOfCameras(Record):
    """The noise models that were measured with."""

    cam1: ReportedNoise | None = None
    cam2: ReportedNoise | None = None


class ReportedSettings(Record):
    """Settings of the analysis; None: the result files do not state it."""

    reference: int = 0
    subset_px: float | None = None
    spacing_px: float | None = None
    dense_step_px: float | None = None
    prefilter_px: float | None = None
    max_sigma_px: float | None = None
    interpolation: str | None = None
    reference_update: str | None = None
    patch: str | None = None
    strain: object = None
    noise: NoiseOfCameras = NoiseOfCameras()
    region: ReportedRegion = ReportedRegion()
