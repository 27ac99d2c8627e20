"""A report from top to bottom."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from core.field.points.result import Field
from core.names import CAMERAS
from server.formats.version import software_version
from server.report import pictures, sections
from server.report.floor import STRAINS
from server.report.geometry import geometry
from server.report.hardware import hardware, image_sizes
from server.report.histories import histories
from server.report.page import Markup, document, element, picture, policy_of, section, style_of
from server.report.settings import analysis
from server.report.source import Source
from server.report.steps import Measured, Shown, read_steps

_COMPONENTS = (("U", 0), ("V", 1), ("W", 2))


@dataclass(frozen=True)
class Report:
    """A report.

    Attributes
    ----------
    page
        One HTML file that needs nothing else.
    policy
        The Content-Security-Policy that suffices for it; it stands in the page too.
    missing
        What is not stated in it, and how it can be.
    """

    page: bytes
    policy: str
    missing: list[tuple[str, str]]


def make_report(source: Source) -> Report:
    """Return the report.

    Raises
    ------
    FileFormatError
        A result file that cannot be read.
    """
    measured = read_steps(source)
    found = None
    if source.calibration is not None:
        found = geometry(source.calibration.pair, measured.reference, image_sizes(source))
    rig, settings = hardware(source, measured, found), analysis(source, measured, found)
    test_part, test_items = sections.the_test(source, measured)
    floor_part, floor_missing = sections.noise_floor(source, measured)
    calibration_part, calibration_missing = sections.calibration_record(source, measured)
    seen, seen_missing = _reference(source, measured)
    loads = any(s.load_n is not None for s in measured.steps)
    more = [*floor_missing, *calibration_missing, *seen_missing]
    if not loads:
        more.append(("Load of the steps", "give load_n with each step"))
    if source.facts.gauges is None and len(measured.steps) > 1:
        more.append(("Gauges", "name extensometers, points, areas or lines in `gauges` of the facts"))
    listed = [*test_items, *rig, *settings]
    missing = [*((name, item.remedy) for item in listed for name in item.missing), *more]
    tables: list[object] = [sections.steps_table(measured, loads=loads)]
    tables += [part for part in (sections.motion_table(measured), sections.quality_table(measured)) if part is not None]
    made = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    body = [
        *sections.head(source, measured, made, software_version()),
        test_part,
        section("Hardware parameters", "hardware", sections.items_table(rig, "hardware-table")),
        section("Analysis parameters", "analysis", sections.items_table(settings, "analysis-table")),
        floor_part,
        calibration_part,
        section("What the cameras saw", "seen", *seen),
        section("Fields", "fields", *_fields(measured)),
        section("Steps", "steps", *tables),
        section("Histories", "histories", *histories(source, measured)),
        sections.not_stated(missing),
        sections.provenance(source, source.facts),
    ]
    title = f"{source.title}: report"
    style = style_of(f"{source.title}  \u00b7  stereorig {software_version()}  \u00b7  {made}")
    return Report(document(title, style, body).encode(), policy_of(style), missing)


def _reference(source: Source, measured: Measured) -> tuple[list[Markup], list[tuple[str, str]]]:
    """Both cameras' reference images with the measured points."""
    field = measured.reference
    drawn, missing = [], []
    valid = field.valid.ravel()
    for cam in CAMERAS:
        image = source.reference_image(cam)
        name = cam.replace("cam", "camera ")
        if image is None:
            remedy = "the file must lie where it was measured from, with the same checksum"
            missing.append((f"Reference image of {name}", remedy))
            continue
        if cam == "cam1":
            places = np.stack([field.x_px.ravel(), field.y_px.ravel()], axis=-1)
        elif source.calibration is not None:
            found = source.calibration.pair.cam2.project(field.xyz_mm.reshape(-1, 3))
            places = np.where(found.valid[:, None], found.xy, np.nan)
        else:
            places = np.empty((0, 2))
        chosen = valid if len(places) == len(valid) else np.empty(0, dtype=bool)
        cuts, outline = (field.cuts, _outline(source)) if cam == "cam1" else (None, None)
        data = pictures.region(image, places, chosen, f"{name}, step {source.reference}", cuts, outline)
        caption = f"{name.capitalize()}, reference: green where a point was measured, red where not"
        caption += ", yellow the region that was asked for" if outline is not None else ""
        drawn.append(picture(data, pictures.PNG, f"reference image of {name} with the measured points", caption))
    parts = [element("div", *drawn, class_="pair")] if drawn else []
    parts += [element("p", f"{name} is not shown: {remedy}.", class_="missing") for name, remedy in missing]
    return parts, missing


def _outline(source: Source) -> NDArray[np.float64] | None:
    """Corners of the region that was asked for, in camera 1's reference image."""
    region = source.settings.get("region") or {}
    if region.get("polygon"):
        return np.asarray(region["polygon"], dtype=np.float64)
    rectangle = region.get("rectangle") or source.settings.get("roi")
    if not rectangle:
        return None
    x0, y0, x1, y1 = rectangle
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def _fields(measured: Measured) -> list[Markup]:
    """Maps of the reference's shape, of the steps that are shown, and of the points' states."""
    text = "Colours end at the 1st and the 99th percentile. White: no value; nothing is filled in."
    parts = [element("p", text, class_="note lead")]
    reference = measured.reference
    height = pictures.field_map(reference, reference.xyz_mm[..., 2], "Z of the reference", "Shape, Z")
    drawn = [picture(height, pictures.PNG, "map of the reference's Z", "Shape of the reference: Z", half=True)]
    if not measured.shown:
        drawn.append(_status(reference, "the reference"))
    parts.append(element("div", *drawn, class_="pair"))
    for shown in measured.shown:
        parts.append(element("h3", f"Step {shown.n}: {shown.why}"))
        parts.append(element("div", *_maps(shown), class_="pair"))
    return parts


def _status(field: Field, what: str) -> Markup:
    data = pictures.status_map(field, f"States of the points, {what}")
    return picture(data, pictures.PNG, f"map of the points' states, {what}", f"States of the points, {what}", half=True)


def _maps(shown: Shown) -> list[Markup]:
    field, drawn = shown.field, []
    layers: list[tuple[str, NDArray[np.float64], bool]] = []
    if field.uvw_mm is not None:
        layers += [(name, field.uvw_mm[..., k], False) for name, k in _COMPONENTS]
    else:
        layers.append(("Z", field.xyz_mm[..., 2], False))
    if shown.strain is not None and shown.strain.valid.any():
        layers += [(name, pictures.strain_values(shown.strain, k), True) for k, name in enumerate(STRAINS)]
    for name, values, strain in layers:
        data = pictures.field_map(field, values, name, f"{name}, step {shown.n}", strain=strain)
        drawn.append(
            picture(data, pictures.PNG, f"map of {name} in step {shown.n}", f"{name}, step {shown.n}", half=True)
        )
    sigma, name = field.sigma_mm[..., -1], "W" if field.has_motion else "Z"
    data = pictures.field_map(field, sigma, "standard deviation", f"sigma of {name}, step {shown.n}")
    alt = f"map of the predicted standard deviation in step {shown.n}"
    drawn.append(picture(data, pictures.PNG, alt, f"Predicted standard deviation of {name}", half=True))
    drawn.append(_status(field, f"step {shown.n}"))
    return drawn
