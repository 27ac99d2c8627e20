"""The analysis parameters: the reporting tables of the iDICs Good Practices Guide (2018)."""

from __future__ import annotations

from stereorig.core.field.points.smoothing_record import METHOD
from stereorig.server.formats.version import software_version
from stereorig.server.report.geometry import Geometry
from stereorig.server.report.items import MEASURED, SETTINGS, Item, Value, one
from stereorig.server.report.records import ReportedSettings
from stereorig.server.report.source import Source
from stereorig.server.report.steps import MeasuredSteps

_SHAPES = {
    "rigid": "plane patch, rigid motion (9 unknowns), projected by both calibrated cameras",
    "affine": "plane patch, rigid motion and in-plane stretch (12 unknowns), projected by both calibrated cameras",
    "quadratic": "patch of second order in shape and motion, projected by both calibrated cameras",
}
_FITS = {1: "planes", 2: "quadratics", "auto": "planes or, if one-sided, quadratics"}
_TENSORS = {
    "green_lagrange": "Green-Lagrange, E = (C - I) / 2",
    "infinitesimal": "infinitesimal, symmetric part of the displacement gradient",
    "hencky": "Hencky (logarithmic), ln(C) / 2",
}
_REFERENCES = {
    "never": "the first for all steps (total)",
    "always": "the step before (incremental), reported as totals",
    "auto": "the first, or a later one if that fails, reported as totals",
}
_CRITERION = (
    "zero-mean normalised sum of squared differences (ZNSSD), "
    "camera 2 at the reference, camera 1 and camera 2 at the step against camera 1's reference subset"
)


def analysis(source: Source, measured: MeasuredSteps, found: Geometry | None) -> list[Item]:
    """Return the analysis parameters."""
    settings = source.settings
    scale = None if found is None else found.views["cam1"].mean_scale_mm_per_px

    def length(px: float | None, suffix: str = "") -> Value | None:
        if px is None:
            return None
        mm = "" if scale is None else f" = {px * scale:.4g} mm"
        return Value(f"{px:g} px{mm}{suffix}", float(px), SETTINGS)

    needs = "the result files do not state it: measure again with this program"
    head = source.heads[max(source.heads)]
    version = f"stereorig {head.software_version} (results), stereorig {software_version()} (this report)"
    interpolation = settings.interpolation
    return [
        one("software", "Software", Value(version, None, "written in the results")),
        one("prefilter", "Image filtering", _prefilter(settings), needs),
        one("subset", "Subset size", length(settings.subset_px), needs, "width of the square subset"),
        one("step", "Step size", length(settings.spacing_px), needs, "distance of the points"),
        *_dense(settings, length(settings.dense_step_px, f", {METHOD}")),
        one("shape_function", "Subset shape function", _shape_function(measured, settings), needs),
        one("criterion", "Matching criterion", Value(_CRITERION, None, "of this program")),
        one(
            "interpolant",
            "Interpolant",
            None if interpolation is None else Value(f"{interpolation} B-spline", None, SETTINGS),
            needs,
        ),
        one(
            "max_sigma",
            "Largest sigma of a match",
            length(settings.max_sigma_px),
            needs,
            "points beyond it are rejected",
        ),
        one("reference_update", "Reference", _reference(settings), needs, _matched(measured)),
        one("smoothing", "Smoothing of displacements", _smoothing(measured)),
        *_strain_items(source, measured),
        one("frame", "Coordinate system", Value(head.frame, None, "written in the results")),
        one("points", "Points", Value(_points(measured), float(measured.steps[0].summary.points), MEASURED)),
        one("region", "Region", _region(settings), needs),
    ]


def _dense(settings: ReportedSettings, distance: Value | None) -> list[Item]:
    if settings.dense_step_px is None:
        return []
    comment = "distance of its vectors, which share most of their pixels; its files are in the folder dense"
    return [one("dense", "Dense field", distance, comment=comment)]


def _prefilter(settings: ReportedSettings) -> Value | None:
    blur = settings.prefilter_px
    if blur is None:
        return None
    text = f"Gaussian, standard deviation {blur:g} px, on all images" if blur else "none"
    return Value(text, float(blur), SETTINGS)


def _reference(settings: ReportedSettings) -> Value | None:
    update = settings.reference_update
    return None if update is None else Value(_REFERENCES.get(update, update), None, SETTINGS)


def _smoothing(measured: MeasuredSteps) -> Value:
    smoothing = measured.steps[-1].summary.smoothing
    if smoothing is None:
        return Value("none", None, SETTINGS)
    mm = "" if smoothing.resolution_mm is None else f" ({smoothing.resolution_mm:.3g} mm)"
    text = f"polynomial of order {smoothing.order} over {smoothing.window} x {smoothing.window} points; "
    text += f"spatial resolution {smoothing.resolution_px:g} px{mm}"
    return Value(text, float(smoothing.resolution_px), SETTINGS)


def _shape_function(measured: MeasuredSteps, settings: ReportedSettings) -> Value | None:
    choice = measured.steps[-1].summary.patch
    name = choice.patch if choice else settings.patch
    if name is None:
        return None
    asked = f"; {choice.reason}" if choice and choice.asked == "auto" else ""
    return Value(f"{name}: {_SHAPES.get(name, '')}{asked}", None, SETTINGS)


def _matched(measured: MeasuredSteps) -> str:
    others = sorted({s.summary.reference_step for s in measured.steps if s.summary.reference_step is not None})
    return "" if not others else f"matched against step {', '.join(map(str, others))}"


def _points(measured: MeasuredSteps) -> str:
    first, min_valid = measured.steps[0].summary, min(measured.steps, key=lambda s: s.summary.valid)
    return (
        f"{first.points} in the region; valid in the reference {first.valid}, "
        f"fewest {min_valid.summary.valid} in step {min_valid.n}"
    )


def _region(settings: ReportedSettings) -> Value:
    region = settings.region
    parts: list[str] = []
    for outline in (region, *region.outlines):
        if outline.rectangle:
            parts.append("rectangle {:g}, {:g} to {:g}, {:g} px".format(*outline.rectangle))
        if outline.polygon:
            parts.append(f"polygon of {len(outline.polygon)} corners")
        if outline.circle:
            parts.append("circle about {:g}, {:g} px, radius {:g} px".format(*outline.circle))
    parts += [f"{len(region.cracks)} cracks"] if region.cracks else []
    parts += [f"{len(region.holes)} holes"] if region.holes else []
    parts += ["mask"] if region.mask else []
    return Value(", ".join(parts) or "the whole image", None, SETTINGS)


def _strain_items(source: Source, measured: MeasuredSteps) -> list[Item]:
    strain = next((s.strain for s in reversed(measured.steps) if s.strain), None)
    settings = source.settings.strain
    if strain is None:
        text = "no strain was computed" if not settings else "no strain: no window of points was whole enough"
        if all(not s.summary.displacement_mm for s in measured.steps):
            text = "no displacement was measured, so no strain"
        return [one("strain", "Strain", Value(text, None, SETTINGS))]
    window = strain.window
    mm = "" if strain.gauge_mm is None else f" = {strain.gauge_mm:.4g} mm"
    fit = f"{window} x {window} points, {_FITS[strain.order]} through their displacements"
    return [
        one(
            "strain",
            "Strain formulation",
            Value(_TENSORS.get(strain.tensor, strain.tensor), None, SETTINGS),
            "",
            "in the reference's tangent plane; shear is the tensor's, half of the engineering shear",
        ),
        one("strain.window", "Strain window", Value(fit, float(window), SETTINGS)),
        one(
            "strain.gauge",
            "Virtual strain gauge size",
            Value(f"{strain.gauge_px:g} px{mm}", float(strain.gauge_px), SETTINGS),
            "",
            "(window - 1) x step + subset; the smoothing's window where displacements were smoothed",
        ),
        one("strain.filter", "Post-filtering of strain", Value("none", None, "of this program")),
    ]
