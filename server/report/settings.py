"""The analysis parameters: those of the reporting tables of the iDICs Good Practices Guide (2018)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from server.formats.version import software_version
from server.report.geometry import Geometry
from server.report.items import MEASURED, SETTINGS, Item, Value
from server.report.source import Source
from server.report.steps import Measured

_SHAPES = {
    "rigid": "plane patch, rigid motion (9 unknowns), seen through both calibrated cameras",
    "stretch": "plane patch, rigid motion and in-plane stretch (12 unknowns), seen through both calibrated cameras",
    "curved": "patch of second order in shape and motion, seen through both calibrated cameras",
}
_TENSORS = {
    "green_lagrange": "Green-Lagrange, E = (C - I) / 2",
    "infinitesimal": "infinitesimal, symmetric part of the displacement gradient",
    "hencky": "Hencky (logarithmic), ln(C) / 2",
}


def analysis(source: Source, measured: Measured, found: Geometry | None) -> list[Item]:
    """Return the analysis parameters."""
    settings, head = source.settings, source.heads[max(source.heads)]
    scale = None if found is None else found.views["cam1"].mean_scale_mm_per_px

    def length(px: float | None, what: str = "") -> Value | None:
        if px is None:
            return None
        mm = "" if scale is None else f" = {px * scale:.4g} mm"
        return Value(f"{px:g} px{mm}{what}", float(px), SETTINGS)

    needs = "the result files do not say it: measure again with this program"
    blur = settings.get("prefilter_px")
    smoothing = measured.steps[-1].summary.smoothing
    update = settings.get("reference_update")
    return [
        Item(
            "software",
            "Software",
            (
                Value(
                    f"stereorig {head['software_version']} (results), stereorig {software_version()} (this report)",
                    None,
                    "written in the results",
                ),
            ),
        ),
        Item(
            "prefilter",
            "Image filtering",
            (
                None
                if blur is None
                else Value(
                    f"Gaussian, standard deviation {blur:g} px, on all images" if blur else "none",
                    float(blur),
                    SETTINGS,
                ),
            ),
            needs,
        ),
        Item("subset", "Subset size", (length(settings.get("subset_px")),), needs, "width of the square subset"),
        Item("step", "Step size", (length(settings.get("step_px")),), needs, "distance of the points"),
        Item("shape_function", "Subset shape function", (_shape_function(measured, settings),), needs),
        Item(
            "criterion",
            "Matching criterion",
            (
                Value(
                    "zero-mean normalised sum of squared differences (ZNSSD), "
                    "camera 2 at the reference, camera 1 and camera 2 at the step against camera 1's reference subset",
                    None,
                    "of this program",
                ),
            ),
        ),
        Item(
            "interpolant",
            "Interpolant",
            (
                None
                if settings.get("interpolation") is None
                else Value(f"{settings['interpolation']} B-spline", None, SETTINGS),
            ),
            needs,
        ),
        Item(
            "reference_update",
            "Reference",
            (
                None
                if update is None
                else Value(
                    {
                        "never": "the first for all steps (total)",
                        "always": "the step before (incremental), told as totals",
                        "auto": "the first, or a later one where that fails, told as totals",
                    }.get(update, str(update)),
                    None,
                    SETTINGS,
                ),
            ),
            needs,
            _matched(measured),
        ),
        Item(
            "smoothing",
            "Smoothing of displacements",
            (
                Value("none", None, SETTINGS)
                if not smoothing
                else Value(
                    f"polynomial of order {smoothing.order} over {smoothing.window} x {smoothing.window}"
                    f" points; {smoothing.resolution_px:g} px"
                    + ("" if smoothing.resolution_mm is None else f" ({smoothing.resolution_mm:.3g} mm)")
                    + " are told apart",
                    float(smoothing.resolution_px),
                    SETTINGS,
                ),
            ),
        ),
        *_strain_items(source, measured),
        Item("frame", "Coordinate system", (Value(str(head.get("frame", "")), None, "written in the results"),)),
        Item("points", "Points", (Value(_points(measured), float(measured.steps[0].summary.points), MEASURED),)),
        Item("region", "Region", (_region(settings),), needs),
    ]


def _shape_function(measured: Measured, settings: Mapping[str, Any]) -> Value | None:
    choice = measured.steps[-1].summary.patch
    name = choice.patch if choice else settings.get("patch")
    if name is None:
        return None
    asked = f"; {choice.reason}" if choice and choice.asked == "auto" else ""
    return Value(f"{name}: {_SHAPES.get(name, '')}{asked}", None, SETTINGS)


def _matched(measured: Measured) -> str:
    others = sorted({s.summary.reference_step for s in measured.steps if s.summary.reference_step is not None})
    return "" if not others else f"matched against step {', '.join(map(str, others))}"


def _points(measured: Measured) -> str:
    first, least = measured.steps[0].summary, min(measured.steps, key=lambda s: s.summary.valid)
    return (
        f"{first.points} in the region; valid in the reference {first.valid}, "
        f"fewest {least.summary.valid} in step {least.n}"
    )


def _region(settings: Mapping[str, Any]) -> Value | None:
    region = settings.get("region") or {"rectangle": settings.get("roi"), **settings}
    rectangle, polygon = region.get("rectangle"), region.get("polygon")
    parts = []
    if rectangle:
        parts.append("rectangle {:g}, {:g} to {:g}, {:g} px".format(*rectangle))
    if polygon:
        parts.append(f"polygon of {len(polygon)} corners")
    for name in ("cracks", "holes"):
        if region.get(name):
            parts.append(f"{len(region[name])} {name}")
    if region.get("mask"):
        parts.append("mask")
    return Value(", ".join(parts), None, SETTINGS) if parts else Value("the whole image", None, SETTINGS)


def _strain_items(source: Source, measured: Measured) -> list[Item]:
    strain = next((s.strain for s in reversed(measured.steps) if s.strain), None)
    settings = source.settings.get("strain")
    if strain is None:
        text = "no strain was computed" if not settings else "no strain: no window of points was whole enough"
        if all(not s.summary.displacement_mm for s in measured.steps):
            text = "no displacement was measured, so no strain"
        return [Item("strain", "Strain", (Value(text, None, SETTINGS),))]
    mm = strain.gauge_mm
    window = strain.window
    return [
        Item(
            "strain",
            "Strain formulation",
            (Value(_TENSORS.get(strain.tensor, strain.tensor), None, SETTINGS),),
            "",
            "in the reference's tangent plane; shear is the tensor's, half of the engineering shear",
        ),
        Item(
            "strain.window",
            "Strain window",
            (
                Value(
                    f"{window} x {window} points, polynomial of order {strain.order} through their displacements",
                    float(window),
                    SETTINGS,
                ),
            ),
        ),
        Item(
            "strain.gauge",
            "Virtual strain gauge size",
            (
                Value(
                    f"{strain.gauge_px:g} px" + ("" if mm is None else f" = {mm:.4g} mm"),
                    float(strain.gauge_px),
                    SETTINGS,
                ),
            ),
            "",
            "(window - 1) x step + subset; the smoothing's window where displacements were smoothed",
        ),
        Item("strain.filter", "Post-filtering of strain", (Value("none", None, "of this program"),)),
    ]
