"""A report from top to bottom: everything gathered, then filled into the templates."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.lay_points import corners_px
from stereorig.core.names import ALL_PARTS, BUDGET, CAMERAS
from stereorig.core.progress import Progress, no_progress
from stereorig.core.settings import CoverageFields, Outline
from stereorig.server.formats.results.camera_motion import MOVED_REMEDY
from stereorig.server.formats.results.uncertainty import NOT_INCLUDED, Statement
from stereorig.server.formats.version import software_version
from stereorig.server.report import pictures
from stereorig.server.report.calibration import CalibrationPart, calibration_gaps
from stereorig.server.report.evidence.models import compared_models
from stereorig.server.report.floor import STRAINS
from stereorig.server.report.geometry import geometry
from stereorig.server.report.hardware import hardware, image_sizes
from stereorig.server.report.histories import courses, gauges
from stereorig.server.report.items import METADATA_FORM, UM, Item, Missing, Value, plain
from stereorig.server.report.page import PNG, PagePicture, kept_logo, read_logo, render
from stereorig.server.report.settings import analysis
from stereorig.server.report.source import Source
from stereorig.server.report.steps import DrawnStep, MeasuredSteps, read_steps
from stereorig.server.report.task import ReportOptions, chosen_sections
from stereorig.server.report.uncertainty import field_budgets, sentence

T = TypeVar("T")
#: sections that take the time, in the order in which they are made
_SLOW = ("seen", "histories", "fields", "models")
_COMPONENTS = (("U", 0), ("V", 1), ("W", 2))
_LEVELS = {"ok": "good", "good": "good", "warning": "warning", "failed": "failed"}


@dataclass(frozen=True)
class Report:
    """A report.

    Attributes
    ----------
    page
        One HTML file that needs nothing else.
    policy
        The Content-Security-Policy that suffices for it; the page holds it too.
    missing
        Items that are not stated in it, each with a remedy.
    """

    page: bytes
    policy: str
    missing: list[Missing]


@dataclass(frozen=True)
class Box:
    """A figure at a glance; ``level`` colours it."""

    name: str
    value: str
    small: str
    level: str = ""


@dataclass(frozen=True)
class Origin:
    """Settings and metadata as they are on file, and by result file the checksums of its inputs."""

    settings: str
    metadata: str
    inputs: list[tuple[str, list[tuple[str, str]]]]


def make_report(
    source: Source,
    coverage: CoverageFields | None = None,
    options: ReportOptions | None = None,
    progress: Progress = no_progress,
) -> Report:
    """Return the report.

    Parameters
    ----------
    source
        Result files, records, calibration and metadata.
    coverage
        Coverage of the stated uncertainties; None: the metadata's gauges', or one standard uncertainty.
    options
        Sections, logo, links; None: every section, the logo of the data folder, no links.
    progress
        Receives each step that is read and each section that is drawn.

    Raises
    ------
    FileFormatError
        A result file or a logo that cannot be read.
    InputError
        A section that there is not.
    """
    options = options or ReportOptions()
    sections = chosen_sections(options.sections)
    logo = options.logo or kept_logo(source.test)
    picture = None if logo is None else read_logo(logo)
    measured = read_steps(source, coverage, progress)
    found = None
    if source.calibration is not None:
        found = geometry(source.calibration.pair, measured.reference_sys, image_sizes(source))
    test, rig, settings = (
        the_test(source, measured),
        hardware(source, measured, found),
        analysis(source, measured, found),
    )
    drawn = _Drawn(sections, progress)
    seen, unseen = drawn.of("seen", lambda: _reference(source, measured)) or ([], [])
    missing = [gap for item in (*test, *rig, *settings) for gap in item.missing]
    missing += [*_floor_gaps(source, measured), *calibration_gaps(source, measured), *unseen]
    if not measured.loaded:
        missing.append(Missing("Load of the steps", "give load_n with each step"))
    if source.metadata.gauges is None and len(measured.steps) > 1:
        remedy = (
            "draw extensometers, points, areas or lines on the Results screen, or name them in `gauges` of the metadata"
        )
        missing.append(Missing("Gauges", remedy))
    budget = field_budgets(measured)
    # the uncertainties have a budget of each gauge
    found_gauges = drawn.of("histories" if "histories" in sections else "uncertainty", lambda: gauges(source, measured))
    made = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    page, policy = render(
        f"{source.title}  \u00b7  stereorig {software_version()}  \u00b7  {made}",
        source=source,
        sections=sections,
        logo=picture,
        form_url=_form_url(source, options),
        metadata_form=METADATA_FORM,
        measured=measured,
        under=_under(source, measured, made),
        boxes=_boxes(source, measured),
        test=test,
        rig=rig,
        settings=settings,
        calibration=None if source.calibration is None else CalibrationPart(source.calibration),
        worst=measured.worst_epipolar,
        moved_remedy=MOVED_REMEDY,
        max_extrapolated=max(s.summary.status.get("extrapolated", 0) for s in measured.steps),
        seen=seen,
        unseen=unseen,
        fields=drawn.of("fields", lambda: _fields(measured)),
        courses=courses(measured) if "histories" in sections else None,
        gauges=found_gauges,
        models=drawn.of("models", lambda: compared_models(source)),
        uncertainty=sentence(measured),
        budget=budget,
        budget_names=list(BUDGET if all(row.parts[-1] is None for row in budget[1]) else ALL_PARTS),
        missing=missing,
        origin=_origin(source),
    )
    return Report(page, policy, missing)


@dataclass(frozen=True)
class _Drawn:
    """Makes the parts of the chosen sections alone, and reports each."""

    sections: Sequence[str]
    progress: Progress

    def of(self, section: str, make: Callable[[], T]) -> T | None:
        """Return a part of a section; None if the section was not chosen."""
        if section not in self.sections:
            return None
        slow = [name for name in _SLOW if name in self.sections]
        if section in slow:
            self.progress("drawing", slow.index(section), len(slow))
        return make()


def _form_url(source: Source, options: ReportOptions) -> str:
    """Return the address of the test's screen, which has the form of the metadata; empty if there is none."""
    if not (options.service_url and source.test_record.id):
        return ""
    return f"{options.service_url.rstrip('/')}/#/test/{source.test_record.id}"


def _under(source: Source, measured: MeasuredSteps, made_utc: str) -> list[str]:
    """Return the lines under the title."""
    kind = "displacement" if any(s.max_displacement_mm is not None for s in measured.steps) else "shape"
    under = [f"Report of a {kind} measurement with two cameras", f"{len(measured.steps)} steps"]
    under += [f"test {source.test_record.id}"] if source.test_record.id else []
    under += [f"analysis {source.analysis.id}"] if source.analysis.id else []
    under += [f"\u201c{source.analysis.label}\u201d"] if source.analysis.label else []
    return [*under, f"made {made_utc} by stereorig {software_version()}"]


def _boxes(source: Source, measured: MeasuredSteps) -> list[Box]:
    verdict, held = None, None
    if source.calibration is not None:
        record = source.calibration.record
        verdict = record.verdict.level
        held = None if record.checks is None or record.checks.held_out is None else record.checks.held_out.rbe_px
    held_text = "" if held is None else f"held-out RBE {plain(held, 2)} px"
    worst = measured.worst_epipolar
    level = None if worst is None else worst.level
    off = "" if worst is None else f"{worst.offset_px:.3f} px off the epipolar lines"
    if measured.camera_moved and level != "failed":
        level = "warning"
    share = min((s.summary.valid_fraction for s in measured.steps if s.summary.valid_fraction is not None), default=0.0)
    floor = measured.floor.get("W") or measured.floor.get("Z")
    if floor is not None and floor.spatial_sd is not None:
        noise, small = f"{1e3 * floor.spatial_sd:.2g} {UM}", f"sd of W over the points, {floor.steps} static steps"
    else:
        sigma = measured.reported.get("W", measured.reported.get("Z"))
        noise, small = ("-" if sigma is None else f"{1e3 * sigma:.2g} {UM}"), "predicted (k = 1), no static steps"
        if not measured.statement.included.calibration:
            small += f"; {NOT_INCLUDED}"
    return [
        Box("Calibration", verdict or "no record", held_text, _LEVELS.get(verdict or "", "")),
        Box("Cameras since then", level or "not known", off, _LEVELS.get(level or "", "")),
        Box(
            "Valid points, minimum of the steps",
            f"{100.0 * share:.1f} %",
            f"of {measured.steps[0].summary.points} in the region",
        ),
        Box("Noise, out of plane", noise, small),
    ]


def the_test(source: Source, measured: MeasuredSteps) -> list[Item]:
    """Return the items of the test."""
    metadata = source.metadata
    times = [s.captured_utc for s in measured.steps if s.captured_utc]

    def stated(name: str, label: str, value: str | None) -> Item:
        known = Value(value, None, "as stated") if value else None
        return Item(f"test.{name}", label, (known,), f"{name}, in {METADATA_FORM}")

    taken = None
    if times:
        imported = any(step.source == "import" for step in source.steps.values())
        origin = "import of the files, not their exposure" if imported else "recorded with the images"
        taken = Value(times[0] if len(times) == 1 else f"{times[0]} to {times[-1]}", None, origin)
    return [
        stated("purpose", "Purpose", metadata.purpose),
        stated("specimen", "Specimen", metadata.specimen or source.test_record.specimen),
        stated("material", "Material", metadata.material),
        stated("loading", "Loading", metadata.loading),
        stated("environment", "Environment", metadata.environment),
        stated("laboratory", "Laboratory", metadata.laboratory),
        stated("operator", "Operator", metadata.operator),
        Item("test.images_taken", "Images taken", (taken,), "is recorded when the service captures or imports"),
    ]


def _floor_gaps(source: Source, measured: MeasuredSteps) -> list[Missing]:
    if not measured.static:
        remedy = (
            "take steps before anything is loaded and name them in static_steps, or begin their labels with `static`"
        )
        return [Missing("Noise floor and bias of displacement and strain, from static steps", remedy)]
    gaps = []
    if len(measured.static) == 1:
        gaps.append(Missing("Noise floor from step to step (temporal)", "take at least two static steps"))
    lost = [n for n in source.metadata.static_steps or [] if n not in source.files]
    if lost:
        gaps.append(Missing(f"Results of the static steps {', '.join(map(str, lost))}", "measure them too"))
    if not any(n in measured.floor for n in "UVW"):
        gaps.append(Missing("Noise floor and bias of displacement", "measure displacements of the static steps"))
    return gaps


def _reference(source: Source, measured: MeasuredSteps) -> tuple[list[PagePicture], list[Missing]]:
    """Both cameras' reference images with the measured points, and those that are not there."""
    field = measured.reference_sys
    drawn, missing = [], []
    valid = field.valid.ravel()
    for cam in CAMERAS:
        image = source.reference_image(cam)
        name = cam.replace("cam", "camera ")
        if image is None:
            remedy = "the file must be at its path of the measurement, with the same checksum"
            missing.append(Missing(f"Reference image of {name}", remedy))
            continue
        if cam == "cam1":
            positions = np.stack([field.x_px.ravel(), field.y_px.ravel()], axis=-1)
        elif source.calibration is not None:
            found = source.calibration.pair.cam2.project(field.xyz_mm.reshape(-1, 3))
            positions = np.where(found.valid[:, None], found.xy, np.nan)
        else:
            positions = np.empty((0, 2))
        chosen = valid if len(positions) == len(valid) else np.empty(0, dtype=bool)
        cuts, outlines = (field.cuts, _outlines(source)) if cam == "cam1" else (None, [])
        data = pictures.region(image, positions, chosen, f"{name}, step {source.reference}", cuts, outlines)
        caption = f"{name.capitalize()}, reference: green where a point was measured, red where not"
        caption += ", yellow the region that was asked for" if outlines else ""
        text = f"reference image of {name} with the measured points"
        drawn.append(PagePicture(data, PNG, text, caption, half=False))
    return drawn, missing


def _outlines(source: Source) -> list[NDArray[np.float64]]:
    """Corners of the outlines that were asked for, in camera 1's reference image; none for a mask."""
    region = source.settings.region
    given = (Outline.model_construct(**outline.model_dump()) for outline in (region, *region.outlines))
    return [corners_px(outline) for outline in given if outline.rectangle or outline.polygon or outline.circle]


def _fields(measured: MeasuredSteps) -> list[tuple[str, list[PagePicture]]]:
    """Maps of the reference's shape, of the steps that are drawn, and of the states; each set with its title."""
    reference = measured.reference
    height = pictures.field_map(reference, reference.xyz_mm[..., 2], "Z of the reference", "Shape, Z")
    drawn = [PagePicture(height, PNG, "map of the reference's Z", "Shape of the reference: Z")]
    if not measured.shown:
        drawn.append(_status(reference, "the reference"))
    return [
        *((f"Step {shown.n}: {shown.why}", _maps(shown, measured.statement)) for shown in measured.shown),
        ("The reference", drawn),
    ]


def _status(field: Field, subject: str) -> PagePicture:
    data = pictures.status_map(field, f"States of the points, {subject}")
    return PagePicture(data, PNG, f"map of the points' states, {subject}", f"States of the points, {subject}")


def _maps(shown: DrawnStep, statement: Statement) -> list[PagePicture]:
    field, drawn = shown.field, []
    layers: list[tuple[str, NDArray[np.float64], bool]] = []
    if field.uvw_mm is not None:
        layers += [(name, field.uvw_mm[..., k], False) for name, k in _COMPONENTS]
    else:
        layers.append(("Z", field.xyz_mm[..., 2], False))
    if shown.strain is not None and shown.strain.valid.any():
        layers += [(name, pictures.strain_values(shown.strain, k), True) for k, name in enumerate(STRAINS)]
    for name, values, strain in layers:
        title = f"{name}, step {shown.n}"
        data = pictures.field_map(field, values, name, title, strain=strain)
        drawn.append(PagePicture(data, PNG, f"map of {name} in step {shown.n}", title))
    interval, name = statement.k * field.sigma_mm[..., -1], "W" if field.has_motion else "Z"
    label = "expanded uncertainty" if statement.expanded else "standard uncertainty"
    data = pictures.field_map(field, interval, label, f"{statement.symbol} of {name}, step {shown.n}")
    text = f"map of the predicted uncertainty in step {shown.n}"
    drawn.append(PagePicture(data, PNG, text, f"Predicted {label} of {name}; {statement.text}"))
    drawn.append(_status(field, f"step {shown.n}"))
    return drawn


def _origin(source: Source) -> Origin:
    first = source.heads[max(source.heads)]
    inputs = {n: head.inputs_sha256 for n, head in source.heads.items()}
    common = {k: v for k, v in inputs[max(inputs)].items() if all(found.get(k) == v for found in inputs.values())}
    rows = [("all steps", sorted(common.items()))]
    for n, path in source.files.items():
        written = source.heads[n].created
        name = f"{path.name}, written {written}" if written else path.name
        rows.append((name, sorted((k, v) for k, v in inputs[n].items() if k not in common)))
    stated = source.metadata.document()
    return Origin(
        settings=json.dumps(first.settings, sort_keys=True, ensure_ascii=False),
        metadata=json.dumps(stated, ensure_ascii=False) if stated else "",
        inputs=rows,
    )
