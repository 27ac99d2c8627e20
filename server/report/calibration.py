"""The calibration's record in a report: checks, parameters with their uncertainty, target, positions, verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from core.cameras.camera import ELEVEN_PARAMETER_NAMES
from core.names import CAMERAS
from server.report.items import plain
from server.report.page import Cell, Markup, element, note, table
from server.report.source import Source

_CHECKS = (
    ("rbe_px", "RBE (mean distance of found and projected intersections)", "px"),
    ("raz_mm", "RAZ (mean distance of intersections and found ones, projected back on the target)", "mm"),
    ("nsce", "NSCE (the same over what a pixel's rounding would make of it)", ""),
)
_UNITS = {"px2": "1/px\u00b2", "px": "px", "rad": "rad", "mm": "mm"}


def record(source: Source) -> tuple[list[Markup], list[tuple[str, str]]]:
    """Return the parts of the section, and what is missing from it with its remedy."""
    loaded = source.calibration
    if loaded is None:
        remedy = "give the file that the results were measured with (--calibration)"
        return [element("p", "The calibration was not found.", class_="missing")], [("Calibration record", remedy)]
    if not loaded.details.get("checks"):
        kind = {"dice_xml": "DICe XML", "opencv_yaml": "OpenCV YAML"}.get(loaded.source, loaded.source)
        parts = [
            element("p", f"Cameras from {_name(source)} ({kind}). The file has no record of how they were calibrated.")
        ]
        parts.append(_cameras_alone(source))
        remedy = "calibrate with this program, or file the other program's own record with this report"
        return parts, [("Calibration checks (RBE, RAZ, NSCE), parameters' uncertainty, target, positions", remedy)]
    content = loaded.details
    missing = []
    if content["checks"].get("held_out") is None:
        missing.append(("Calibration checks at held-out positions", "calibrate with held_out_mm"))
    parts = [
        _verdict(content),
        _checks(content),
        _made(content),
        _parameters(content),
        _views(content),
        _target(content),
    ]
    return [p for p in parts if p], missing


def _name(source: Source) -> str:
    return "" if source.calibration_file is None else source.calibration_file.name


def _verdict(content: Mapping[str, Any]) -> Markup:
    verdict = content.get("verdict") or {}
    level = str(verdict.get("level", "not told"))
    reasons = [element("li", reason) for reason in verdict.get("reasons", [])]
    return element(
        "div", element("p", "Verdict: ", element("b", level), id="calibration-verdict"), element("ul", *reasons)
    )


def _checks(content: Mapping[str, Any]) -> Markup:
    rows, keys = [], []
    for name, label, unit in _CHECKS:
        for which, told in (("fitted", "positions that were fitted"), ("held_out", "held-out positions")):
            measures = content["checks"].get(which)
            values = [None, None, None]
            if measures is not None:
                each = measures.get("per_camera", {})
                values = [measures.get(name), *((each.get(cam) or {}).get(name) for cam in CAMERAS)]
            rows.append([f"{label}, {told}", *(_number(v, unit) for v in values)])
            keys.append(f"calibration.{which}.{name}")
    return table(
        ["check", "both cameras", "camera 1", "camera 2"], rows, keys=keys, key="calibration-checks", caption="Checks"
    )


def _made(content: Mapping[str, Any]) -> Markup:
    made = [c for c in content["checks"].get("made", []) if isinstance(c, dict) and c.get("text")]
    lines = [element("li", f"{check['name'].replace('_', ' ')}: {check['text']}") for check in made]
    found = content.get("uncertainty") or {}
    if found.get("shape_rms_mm") is not None:
        text = f"uncertainty that it leaves in shape: {1e3 * found['shape_rms_mm']:.3g} \u00b5m rms"
        if found.get("predicted_shape_rms_mm") is not None:
            text += f" ({1e3 * found['predicted_shape_rms_mm']:.3g} \u00b5m were predicted)"
        if found.get("scale") is not None:
            text += f", {1e6 * found['scale']:.3g} ppm in scale"
        lines.append(element("li", text))
    return element("ul", *lines) if lines else Markup("")


def _parameters(content: Mapping[str, Any]) -> Markup:
    sigma = content.get("sigma") or {}
    rows, keys = [], []
    for name in ELEVEN_PARAMETER_NAMES:
        unit = next((told for end, told in _UNITS.items() if name.endswith(f"_{end}")), "")
        if name.endswith("per_px2"):
            unit = _UNITS["px2"]
        cells: list[object] = []
        for cam in CAMERAS:
            value, sd = content[cam][name], sigma.get(f"{cam}.{name}")
            cells.append(Cell(_with_sd(float(value), sd), float(value)))
        rows.append(
            [f"{name.rsplit('_', 1)[0] if unit and not name.endswith('px2') else name.split('_')[0]}", *cells, unit]
        )
        keys.append(f"parameter.{name}")
    return Markup(
        table(
            ["parameter", "camera 1", "camera 2", "unit"],
            rows,
            keys=keys,
            key="calibration-parameters",
            caption="Parameters, value \u00b1 standard deviation",
        )
        + note(
            "The aspect ratio is given, not fitted. Standard deviations are those of each parameter alone; the file "
            "holds the full covariance."
        )
    )


def _with_sd(value: float, sd: float | None) -> str:
    if sd is None or not np.isfinite(sd) or sd <= 0.0:
        return f"{value:.8g}" + ("" if sd is None else " (fixed)")
    exponent = int(np.floor(np.log10(sd)))
    if exponent < -7:
        power = int(np.floor(np.log10(max(abs(value), sd))))
        places = max(power - exponent + 1, 0)
        return f"({value / 10.0**power:.{places}f} \u00b1 {sd / 10.0**power:.{places}f}) \u00b7 10^{power}"
    places = max(1 - exponent, 0)
    return f"{value:.{places}f} \u00b1 {sd:.{places}f}"


def _views(content: Mapping[str, Any]) -> Markup:
    rows = []
    for view in content.get("views", []):
        rows.append(
            [
                str(view["camera"]).replace("cam", "camera "),
                _number(view["dz_mm"], "mm"),
                "held out" if view.get("held_out") else "fitted",
                _number(view.get("rbe_px"), "px"),
                _number(view.get("raz_mm"), "mm"),
                _number(view.get("nsce"), ""),
            ]
        )
    caption = "Positions of the cameras before the target"
    return table(["camera", "dZ", "use", "RBE", "RAZ", "NSCE"], rows, caption=caption, key="calibration-views")


def _target(content: Mapping[str, Any]) -> Markup:
    target = content.get("target") or {}
    if not target:
        return Markup("")
    told = content.get("provenance") or {}
    tilt = (content.get("settings") or {}).get("axis_tilt_sigma_rad")
    ground = "dark lines on bright ground" if target.get("dark_lines", True) else "bright lines on dark ground"
    text = (
        f"Target: grid of {target['lines'][0]} x {target['lines'][1]} lines, pitch {target['pitch_mm']:g} mm, "
        f"line width {target['line_width_mm']:g} mm, maker's tolerance "
        f"{target.get('node_tolerance_mm', 0.0):g} mm, {ground}."
    )
    more = [
        f"localiser {told['localiser']}" if told.get("localiser") else "",
        f"{told['frames']} frames averaged at each position" if told.get("frames") else "",
        f"rig {told['rig']!r}" if told.get("rig") else "",
        f"stereorig {told['software_version']}" if told.get("software_version") else "",
        f"axis tilt prior {tilt:g} rad" if tilt else "",
    ]
    made = "; ".join(m for m in more if m)
    return element("p", text, f" Made with {made}." if made else "", id="calibration-target")


def _cameras_alone(source: Source) -> Markup:
    assert source.calibration is not None
    rows = []
    pair = source.calibration.pair
    for cam, camera in zip(CAMERAS, (pair.cam1, pair.cam2), strict=True):
        lens = camera.lens
        told: dict[str, Any] = {f.name: getattr(lens, f.name) for f in fields(lens)} if is_dataclass(lens) else {}
        values = ", ".join(f"{n} = {v:.8g}" for n, v in told.items() if isinstance(v, int | float))
        rows.append([cam.replace("cam", "camera "), type(lens).__name__, values])
    return table(["camera", "lens model", "parameters"], rows, key="calibration-parameters")


def _number(value: float | None, unit: str) -> object:
    if value is None:
        return element("span", "not stated", class_="missing")
    return Cell(f"{plain(float(value), 3)} {unit}".strip(), float(value))
