"""The sections of a report, from top to bottom."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from core.field.checks.epipolar_offset import EpipolarCheck
from core.names import CAMERAS
from server.report import calibration
from server.report.floor import LENGTHS, STRAINS, Floor
from server.report.items import Item, Value, plain
from server.report.page import Cell, Markup, element, note, section, table
from server.report.source import Source
from server.report.steps import Measured, StepFigures
from server.results.metadata import TestFacts

UM = "\u00b5m"
_LEVELS = {"ok": "good", "good": "good", "warning": "warning", "failed": "failed"}
NOT_STATED = Markup('<span class="missing">not stated</span>')


def items_table(items: Sequence[Item], key: str) -> Markup:
    """Return items as a table with a column for each camera."""
    rows, keys = [], []
    for item in items:
        row: list[object] = [item.label]
        single = len(item.values) == 1
        for value in item.values:
            row.append(
                Cell(
                    NOT_STATED if value is None else value.text,
                    None if value is None else value.number,
                    2 if single else None,
                )
            )
        origins = list(dict.fromkeys(v.origin for v in item.values if v is not None and v.origin))
        row.append("; ".join([*origins, *([item.comment] if item.comment else [])]))
        rows.append(row)
        keys.append(item.key)
    return table(["item", "camera 1, or both", "camera 2", "from, remarks"], rows, key=key, keys=keys)


def head(source: Source, measured: Measured, made_utc: str, version: str) -> list[Markup]:
    """Return title, verdicts at a glance, and warnings."""
    analysis_id = source.analysis.get("id")
    kind = "displacement" if any(s.largest_mm is not None for s in measured.steps) else "shape"
    under = [f"Report of a {kind} measurement with two cameras", f"{len(measured.steps)} steps"]
    under += [f"test {source.test_document['id']}"] if source.test_document.get("id") else []
    under += [f"analysis {analysis_id}"] if analysis_id else []
    under += [f"\u201c{source.analysis['label']}\u201d"] if source.analysis.get("label") else []
    under += [f"made {made_utc} by stereorig {version}"]
    parts = [element("h1", source.title), element("p", " \u00b7 ".join(under), class_="under")]
    rig = source.steps.get(source.reference, {}).get("rig") or {}
    if rig.get("simulated"):
        parts.append(element("p", "The images are of a simulated rig: no specimen, no laboratory.", class_="warn"))
    for text in source.stale:
        parts.append(element("p", f"Since the results were written: {text}.", class_="warn"))
    parts += [element("p", text, class_="warn") for text in source.doubts]
    parts.append(element("div", *_boxes(source, measured), class_="boxes"))
    return parts


def _boxes(source: Source, measured: Measured) -> list[Markup]:
    content = {} if source.calibration is None else source.calibration.details
    verdict = (content.get("verdict") or {}).get("level")
    held = ((content.get("checks") or {}).get("held_out") or {}).get("rbe_px")
    boxes = [
        _box(
            "Calibration", verdict or "no record", "" if held is None else f"held-out RBE {plain(held, 2)} px", verdict
        )
    ]
    worst = worst_epipolar(measured)
    level = None if worst is None else worst.level
    off = "" if worst is None else f"{worst.offset_px:.3f} px off the epipolar lines"
    boxes.append(_box("Cameras since then", level or "not told", off, level))
    shares = [s.summary.valid_fraction for s in measured.steps if s.summary.valid_fraction is not None]
    share = min(shares) if shares else 0.0
    boxes.append(_box("Valid points, least of the steps", f"{100.0 * share:.1f} %", _of_points(measured), None))
    floor = measured.floor.get("W") or measured.floor.get("Z")
    if floor is not None and floor.spatial_sd is not None:
        text, small = f"{1e3 * floor.spatial_sd:.2g} {UM}", f"sd of W over the points, {floor.steps} static steps"
    else:
        sigma = measured.told.get("W", measured.told.get("Z"))
        text, small = ("-" if sigma is None else f"{1e3 * sigma:.2g} {UM}"), "predicted, no static steps"
    boxes.append(_box("Noise, out of plane", text, small, None))
    return boxes


def _of_points(measured: Measured) -> str:
    return f"of {measured.steps[0].summary.points} in the region"


def _box(name: str, value: str, small: str, level: str | None) -> Markup:
    return element(
        "div",
        element("b", name),
        element("span", value),
        element("small", small),
        class_=f"box {_LEVELS.get(level or '', '')}".strip(),
    )


def worst_epipolar(measured: Measured) -> EpipolarCheck | None:
    """The step's check that is furthest off; None where none could be made."""
    checks = [s.summary.epipolar_check for s in measured.steps if s.summary.epipolar_check is not None]
    return max(checks, key=lambda c: c.offset_px, default=None)


def the_test(source: Source, measured: Measured) -> tuple[Markup, list[Item]]:
    """Return what was tested, and its items."""
    facts, document = source.facts, source.test_document
    times = [s.captured_utc for s in measured.steps if s.captured_utc]
    fact = "PUT /tests/{id}/facts or facts.toml"

    def told(name: str, label: str, value: str | None = None) -> Item:
        text = value or getattr(facts, name)
        return Item(f"test.{name}", label, (None if not text else Value(text, None, "as told"),), f"{name} of {fact}")

    items = [
        told("purpose", "Purpose"),
        told("specimen", "Specimen", facts.specimen or document.get("specimen") or None),
        told("material", "Material"),
        told("loading", "Loading"),
        told("environment", "Environment"),
        told("laboratory", "Laboratory"),
        told("operator", "Operator"),
        Item(
            "test.images_taken",
            "Images taken",
            (
                None
                if not times
                else Value(times[0] if len(times) == 1 else f"{times[0]} to {times[-1]}", None, _taken(source)),
            ),
            "is recorded when the service captures or imports",
        ),
    ]
    rows = [[i.label, Cell(NOT_STATED if i.values[0] is None else i.values[0].text)] for i in items]
    notes = [text for text in (document.get("notes"), facts.notes) if text]
    parts: list[object] = [table([], rows, key="test-facts", keys=[i.key for i in items])]
    parts += [element("p", text) for text in notes]
    return section("The test", "test", *parts), items


def _taken(source: Source) -> str:
    imported = any(step.get("source") == "import" for step in source.steps.values())
    return "import of the files, not their exposure" if imported else "recorded with the images"


# noise floor --------------------------------------------------------------------------------------------------------


def noise_floor(source: Source, measured: Measured) -> tuple[Markup, list[tuple[str, str]]]:
    """Return noise floor and bias of each quantity, and what is missing from it."""
    missing: list[tuple[str, str]] = []
    rows, keys = [], []
    wanted = [n for n in (*LENGTHS, *STRAINS) if n in measured.floor or n in measured.told]
    for name in wanted:
        rows.append(_floor_row(name, measured.floor.get(name), measured.told.get(name)))
        keys.append(f"floor.{name}")
    remedy = "take steps before anything is loaded and name them in static_steps, or begin their labels with `static`"
    if not measured.static:
        text = "No step is known to be static, so noise floor and bias were not measured. What the points' own "
        text += "covariance predicts stands beside."
        intro = element("p", text, class_="missing")
        missing.append(("Noise floor and bias of displacement and strain, from static steps", remedy))
    else:
        steps = ", ".join(map(str, measured.static))
        intro = element("p", f"From {len(measured.static)} static steps ({steps}), {measured.static_how}.")
        if len(measured.static) == 1:
            missing.append(("Noise floor from step to step (temporal)", "take at least two static steps"))
        told = source.facts.static_steps or []
        lost = [n for n in told if n not in source.files]
        if lost:
            missing.append((f"Results of the static steps {', '.join(map(str, lost))}", "measure them too"))
    if measured.static and not any(n in measured.floor for n in ("U", "V", "W")):
        missing.append(("Noise floor and bias of displacement", "measure displacements of the static steps"))
    head_row = [
        "quantity",
        "bias (mean)",
        "smallest, largest mean of a step",
        "sd from step to step",
        "sd over the points",
        "sd predicted",
        "points",
    ]
    told_text = (
        "Bias: mean over all points and static steps, where the truth is zero; of the places X, Y, Z it cannot be told "
        "without a known position. Sd from step to step (temporal): at each point over the static steps, root mean "
        "square over the points; the reference's own noise is common to all of them and not in it. Sd over the points "
        "(spatial): in each static step, root mean square over the steps; of places, of what a step differs by from "
        "the steps' mean. Predicted: median of what the points' covariances say."
    )
    left = measured.static_left_out
    more = [] if not left else [note(f"Static steps {', '.join(map(str, left))} did not fit into memory.")]
    return (
        section(
            "Noise floor and bias",
            "noise-floor",
            intro,
            table(head_row, rows, keys=keys, key="noise-floor-table"),
            note(told_text),
            *more,
        ),
        missing,
    )


def _floor_row(name: str, floor: Floor | None, told: float | None) -> list[object]:
    factor, unit = (1e6, "microstrain") if name in STRAINS else (1e3, UM)

    def cell(value: float | None, why: str = "not stated") -> object:
        if value is None:
            return element("span", why, class_="missing")
        return Cell(f"{factor * value:.3g} {unit}", value)

    place = name in "XYZ"
    if floor is None:
        return [name, cell(None), "", cell(None), cell(None), cell(told), ""]
    ends = floor.bias_range
    return [
        name,
        cell(floor.bias, "cannot be told" if place else "not stated"),
        "" if ends is None else f"{factor * ends[0]:.3g}, {factor * ends[1]:.3g} {unit}",
        cell(floor.temporal_sd, "needs two static steps"),
        cell(floor.spatial_sd, "needs two static steps" if place else "not stated"),
        cell(told),
        Cell(str(floor.points), float(floor.points)),
    ]


# calibration, steps, what is missing --------------------------------------------------------------------------------


def calibration_record(source: Source, measured: Measured) -> tuple[Markup, list[tuple[str, str]]]:
    """Return the calibration's record with the analysis' own check of it."""
    parts, missing = calibration.record(source)
    worst = worst_epipolar(measured)
    if worst is None:
        missing.append(("Epipolar check of the analysis", "needs at least four measured points"))
    else:
        text = f"Epipolar check of the analysis, furthest of all steps: {worst.level}; {worst.reason}."
        parts.append(element("p", text, id="epipolar-check", data_value=repr(float(worst.offset_px))))
    outside = [s for s in measured.steps if s.summary.status.get("extrapolated")]
    if outside:
        most = max(int(s.summary.status["extrapolated"]) for s in outside)
        text = f"Up to {most} points of a step lie outside the calibrated volume and are marked as extrapolated."
        parts.append(element("p", text))
    return section("Calibration", "calibration", *parts), missing


def _fixed(value: float | None, form: str) -> object:
    return "" if value is None else Cell(f"{value:{form}}", float(value))


def steps_table(measured: Measured, *, loads: bool) -> Markup:
    """Return the table of steps: load, time, valid points, epipolar, sigma, skew and quality."""
    any_time = any(s.seconds is not None for s in measured.steps)
    channels = sorted({name for s in measured.steps for name in s.channels})[:4]
    any_skew = any(s.skew_ms is not None for s in measured.steps)
    columns = [
        "step",
        "label",
        *(["load, N"] if loads else []),
        *channels,
        *(["time, s"] if any_time else []),
        "valid",
        "ZNCC median",
        "epipolar rms, px",
        "check",
        f"sigma X, {UM}",
        "Y",
        "Z",
        f"sigma U, {UM}",
        "V",
        "W",
        *(["skew, ms"] if any_skew else []),
        "image quality",
    ]
    rows = []
    for s in measured.steps:
        summary = s.summary
        sigma = summary.sigma_median_mm
        check = summary.epipolar_check
        zncc = [v for v in summary.zncc_median.values() if v is not None]
        rows.append(
            [
                f"{s.n}{' (static)' if s.static else ''}",
                s.label,
                *([_fixed(s.load_n, "g")] if loads else []),
                *(_fixed(s.channels.get(name), "g") for name in channels),
                *([_fixed(s.seconds, ".3f")] if any_time else []),
                Cell(f"{summary.valid}/{summary.points}", float(summary.valid)),
                _fixed(min(zncc) if zncc else None, ".4f"),
                _fixed(summary.epipolar_residual_rms_px, ".4f"),
                "" if check is None else check.level,
                *(
                    _fixed(None if (mm := sigma.get(k)) is None else 1e3 * mm, ".3g")
                    for k in ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")
                ),
                *([_fixed(s.skew_ms, ".3g")] if any_skew else []),
                "" if s.quality is None else str(s.quality.get("code", "")),
            ]
        )
    return table(columns, rows, key="steps-table", keys=[f"step.{s.n}" for s in measured.steps])


def motion_table(measured: Measured) -> Markup | None:
    """Return what the steps' fields come to: displacement and strain."""
    moved = [s for s in measured.steps if s.summary.displacement_mm]
    if not moved:
        return None
    strains = any(s.strain for s in moved)
    columns = [
        "step",
        *(f"{c}, mean (least, largest), {UM}" for c in "UVW"),
        *((f"{e}, mean, microstrain" for e in STRAINS) if strains else ()),
    ]
    rows = []
    for s in moved:
        cells: list[object] = [str(s.n)]
        for component in ("u", "v", "w"):
            told = (s.summary.displacement_mm or {})[component]
            if told is None:
                cells.append("")
                continue
            mean, low, high = (1e3 * v for v in (told.mean, told.min, told.max))
            cells.append(Cell(f"{mean:.4g} ({low:.4g}, {high:.4g})", told.mean))
        if strains:
            means = {} if s.strain is None else s.strain.mean_microstrain
            cells += [_fixed(means.get(e), ".4g") for e in STRAINS]
        rows.append(cells)
    return table(
        columns, rows, key="motion-table", keys=[f"motion.{s.n}" for s in moved], caption="Over all valid points"
    )


def quality_table(measured: Measured) -> Markup | None:
    """Return the figures of the images."""
    known = [s for s in measured.steps if s.quality]
    if not known:
        return None
    rows = []
    for s in known:
        one, two = ((s.quality or {}).get(cam) or {} for cam in CAMERAS)
        rows.append(
            [
                str(s.n),
                *(
                    _fixed(cam.get(name), form)
                    for name, form in (
                        ("mean_grey", ".1f"),
                        ("contrast_grey", ".1f"),
                        ("saturated_share", ".2%"),
                        ("focus", ".3f"),
                    )
                    for cam in (one, two)
                ),
            ]
        )
    columns = [
        "step",
        *(f"{what}, camera {k}" for what in ("mean grey", "contrast", "saturated", "focus figure") for k in (1, 2)),
    ]
    return table(columns, rows, key="quality-table", caption="Images")


def not_stated(missing: Sequence[tuple[str, str]]) -> Markup:
    """Return the list of what is missing and how it can be stated."""
    if not missing:
        return section("Not stated", "not-stated", element("p", "Nothing that this report asks for is missing."))
    text = f"{len(missing)} items that a reader may want are not stated. Nothing was guessed in their place."
    rows = table(["item", "how to state it"], missing, key="not-stated-table")
    return section("Not stated", "not-stated", element("p", text), rows)


def provenance(source: Source, facts: TestFacts) -> Markup:
    """Return settings, checksums and facts as they are on file."""
    first = source.heads[max(source.heads)]
    inputs = {n: dict(head["inputs_sha256"]) for n, head in source.heads.items()}
    common = {k: v for k, v in inputs[max(inputs)].items() if all(found.get(k) == v for found in inputs.values())}
    rows: list[list[object]] = [["all steps", _hashes(common)]]
    for n, path in source.files.items():
        own = {k: v for k, v in inputs[n].items() if k not in common}
        written = str(source.heads[n].get("created", ""))
        rows.append([f"{path.name}{', written ' if written else ''}{written}", _hashes(own)])
    settings = json.dumps(first.get("settings", {}), sort_keys=True, ensure_ascii=False)
    told = json.dumps(facts.document(), ensure_ascii=False)
    return section(
        "Where it comes from",
        "provenance",
        element("p", "Settings as the result files hold them:"),
        element("pre", settings, id="settings"),
        *([element("p", "Facts as they were told:"), element("pre", told)] if facts.document() else []),
        table(["result file", "SHA-256 of what it was made from"], rows, key="inputs-table"),
    )


def _hashes(found: dict[str, str]) -> Markup:
    return Markup("<br>".join(element("code", f"{name} {digest}") for name, digest in sorted(found.items())))


def axis_of(steps: Sequence[StepFigures]) -> tuple[list[float], str]:
    """Return what a course is drawn over: time since the reference, or the step's number."""
    times = [s.seconds for s in steps]
    known = [t for t in times if t is not None]
    if len(known) == len(times) and len(set(known)) == len(known) and np.isfinite(known).all():
        return known, "time since the reference, s"
    return [float(s.n) for s in steps], "step"
