"""The course of the test: loads, mean motion and strain, and the gauges that were asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from core.errors import StereorigError
from server.report.floor import STRAINS
from server.report.page import Cell, Markup, element, note, picture, table
from server.report.pictures import SVG, course
from server.report.sections import UM, axis_of
from server.report.source import Source
from server.report.steps import Measured
from server.results.gauges.readings import read_gauges

_EXTENSOMETER = ("elongation_mm", "strain")


def histories(source: Source, measured: Measured) -> list[Markup]:
    """Return pictures and tables over the steps."""
    parts = [_own(measured)]
    if source.facts.gauges is not None:
        parts += _gauges(source, measured)
    else:
        parts.append(note("No gauges were asked for (`gauges` of the facts); the curves are means over all points."))
    return [part for part in parts if part]


def _own(measured: Measured) -> Markup:
    steps = measured.steps
    if len(steps) < 2:
        return Markup("")
    x, label = axis_of(steps)
    drawn: list[Markup] = []
    if any(s.load_n is not None for s in steps):
        data = course(x, {"load": ([s.load_n for s in steps], None)}, x_label=label, y_label="load, N", title="Load")
        drawn.append(picture(data, SVG, "load over the steps", "Load as recorded with the steps", half=True))
    for name in sorted({name for s in steps for name in s.channels})[:4]:
        data = course(x, {name: ([s.channels.get(name) for s in steps], None)}, x_label=label, y_label=name, title=name)
        drawn.append(picture(data, SVG, f"{name} over the steps", f"{name} as recorded with the steps", half=True))
    moved = [(xi, s) for xi, s in zip(x, steps, strict=True) if s.summary.displacement_mm]
    if moved:
        lines: dict[str, Any] = {}
        for component in ("u", "v", "w"):
            told = [(s.summary.displacement_mm or {})[component] for _, s in moved]
            lines[component.upper()] = ([None if t is None else 1e3 * t.mean for t in told], None)
        data = course(
            [xi for xi, _ in moved],
            lines,
            x_label=label,
            y_label=f"mean displacement, {UM}",
            title="Displacement, mean over the points",
        )
        drawn.append(
            picture(data, SVG, "mean displacement over the steps", "Mean of U, V, W over all valid points", half=True)
        )
    strained = [(xi, s.strain) for xi, s in zip(x, steps, strict=True) if s.strain and s.strain.points]
    if strained:
        lines = {e: ([s.mean_microstrain[e] for _, s in strained], None) for e in STRAINS}
        data = course(
            [xi for xi, _ in strained],
            lines,
            x_label=label,
            y_label="mean strain, microstrain",
            title="Strain, mean over the points",
        )
        caption = "Mean of the strains over all points that have it"
        drawn.append(picture(data, SVG, "mean strain over the steps", caption, half=True))
    return element("div", *drawn, class_="pair")


def _gauges(source: Source, measured: Measured) -> list[Markup]:
    request = source.facts.gauges
    assert request is not None
    try:
        document = read_gauges(list(source.files.values()), request)
    except StereorigError as error:
        return [element("p", f"The gauges could not be read: {error.cause}", class_="missing")]
    steps = [s for s in document["steps"] if "problem" not in s]
    parts = [
        element("p", f"Step {s['n']}: {s['problem']['cause']}", class_="missing")
        for s in document["steps"]
        if "problem" in s
    ]
    figures = {s.n: s for s in measured.steps}
    x, label = axis_of([figures[s["n"]] for s in steps]) if steps else ([], "step")
    drawn: list[Markup] = []
    for kind, title in (("extensometers", "Extensometer"), ("points", "Point"), ("areas", "Area")):
        for k in range(len(steps[0][kind]) if steps else 0):
            series = [s[kind][k] for s in steps]
            name = f"{title} {series[0]['name']}"
            values = [_of_area(g["values"]) if kind == "areas" else g["values"] for g in series]
            wanted = [n for n in (_EXTENSOMETER if kind == "extensometers" else values[-1]) if n in values[-1]]
            parts.append(_table(name, wanted, values, [s["n"] for s in steps], series))
            curves = [wanted[-1]] if kind == "extensometers" else [n for n in wanted if n in ("u_mm", "v_mm", "w_mm")]
            drawn += _curves(name, curves, values, x, label)
    for k in range(len(steps[-1]["lines"]) if steps else 0):
        drawn += _line(steps[-1]["lines"][k], steps[-1]["n"])
    return [element("div", *drawn, class_="pair"), *parts]


def _of_area(values: dict[str, Any]) -> dict[str, Any]:
    return {n: {"value": v["mean"], "sigma": v["mean_sigma"], "units": v["units"]} for n, v in values.items()}


def _curves(name: str, wanted: Sequence[str], values: list[dict[str, Any]], x: list[float], label: str) -> list[Markup]:
    if not wanted:
        return []
    factor, unit = (1e3, UM) if wanted[0].endswith("_mm") else (1e6, "microstrain")
    lines = {}
    for n in wanted:
        told = [v.get(n) or {} for v in values]
        lines[n.removesuffix("_mm")] = tuple(
            [None if t.get(part) is None else factor * t[part] for t in told] for part in ("value", "sigma")
        )
    data = course(x, lines, x_label=label, y_label=unit, title=name)  # type: ignore[arg-type]
    return [picture(data, SVG, f"{name} over the steps", f"{name}; bars are \u00b1 1 standard deviation", half=True)]


def _line(line: dict[str, Any], n: int) -> list[Markup]:
    drawn = []
    for name, told in list(line["values"].items())[:6]:
        data = course(
            line["distance_px"],
            {name: (told["value"], None)},
            x_label="distance along the line, px",
            y_label=f"{name}, {told['units']}",
            title=f"Line {line['name']}, step {n}",
        )
        drawn.append(
            picture(
                data, SVG, f"{name} along line {line['name']}", f"Line {line['name']}: {name} in step {n}", half=True
            )
        )
    return drawn


def _table(
    name: str, wanted: Sequence[str], values: list[dict[str, Any]], numbers: list[int], series: list[dict[str, Any]]
) -> Markup:
    rows = []
    for n, told, gauge in zip(numbers, values, series, strict=True):
        cells: list[object] = [str(n)]
        for w in wanted:
            t = told.get(w) or {}
            if t.get("value") is None:
                cells.append(element("span", gauge.get("missing") or "no value", class_="missing"))
            else:
                sd = "" if t.get("sigma") is None else f" \u00b1 {t['sigma']:.2g}"
                cells.append(Cell(f"{t['value']:.6g}{sd}", t["value"]))
        rows.append(cells)
    units = {w: next((t[w]["units"] for t in values if w in t), "") for w in wanted}
    columns = ["step", *(f"{w.removesuffix('_mm')}{'' if units[w] in ('', '1') else ', ' + units[w]}" for w in wanted)]
    return table(
        columns,
        rows,
        caption=f"{name}, value \u00b1 standard deviation",
        keys=[f"gauge.{series[0]['name']}.{n}" for n in numbers],
    )
