"""``stereorig expect``: the uncertainties to expect from a rig, a calibration and a measurement."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from stereorig.core.errors import InputError
from stereorig.core.names import BUDGET
from stereorig.core.plan.modulus import PlannedCrack, PlannedTensileTest, modulus_parts
from stereorig.core.plan.settings import PlannedMeasurement, PlannedRig
from stereorig.core.settings import STRAIN_WINDOW

#: options that other commands have by these names
_NAMES = {"subset_px": "--subset", "spacing_px": "--step", "strain_window": "--strain"}
#: causes that a strain has from a motion of the whole body
_OF_CAMERAS = ("calibration", "stage", "target")
_UNSEEN = "a camera does not see the whole gauge"
_M = TypeVar("_M", bound=BaseModel)
_NEEDED = ("image_size_px", "standoff_mm", "angle_deg", "pitch_mm", "lines")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Predict the standard uncertainties of a measurement, with their budget by cause, from nominal values alone: "
        "of a rig file, or of a planned rig."
    )
    parser.add_argument(
        "--rig", metavar="RIG.toml", type=Path, help="rig file; without one the options below state all"
    )
    parser.add_argument(
        "--positions", metavar="-4,0,4", help="dZ of the calibration's fitted positions, mm; left out: the rig file's"
    )
    parser.add_argument(
        "--noise-px", type=float, metavar="PX", help="noise of an intersection's coordinate (default: 0.005 px)"
    )
    parser.add_argument("--roll-deg", type=float, default=0.0, metavar="DEG", help="turn of the target in the images")
    parser.add_argument("--json", action="store_true", help="print the whole document in place of a table")
    for title, model in (
        ("the rig, if it differs from the file", PlannedRig),
        ("measurement", PlannedMeasurement),
        ("a tensile test, whose gauge is area_mm wide", PlannedTensileTest),
        ("a centre-cracked panel", PlannedCrack),
    ):
        group = parser.add_argument_group(title)
        for name, field in model.model_fields.items():
            default = "" if field.default is None else f" (default: {_shown(field.default)})"
            text = f"{field.description or name}{default}".replace("%", "%%").replace("`", "")
            group.add_argument(_option(name), dest=name, metavar=name.rsplit("_", 1)[-1].upper(), help=text)


def run(args: argparse.Namespace) -> int:
    """Predict and print; 1 where such a calibration would be refused."""
    from stereorig.server.compute.calibration.expectation import (
        PlannedCalibration,
        expectation_document,
        rig_as_planned,
    )
    from stereorig.server.evaluations.planned_crack import planned_k
    from stereorig.server.formats.results.summary import to_json
    from stereorig.server.workflows.calibration.sequence import CalibrationPlan, check_plan

    planned = _model(PlannedRig, args)
    measured = _model(PlannedMeasurement, args)
    rig, positions, localiser = _base(args.rig, planned)
    if args.positions is not None:
        positions = tuple(_numbers("--positions", args.positions))
    if args.noise_px is not None and not 1e-6 <= args.noise_px <= 10.0:
        raise InputError(f"--noise-px {args.noise_px:g} is not between 1e-6 and 10 px.")
    check_plan(CalibrationPlan(positions_mm=positions, held_out_mm=(), frames=1, localiser=localiser))
    plan = PlannedCalibration(
        positions_mm=positions, localiser=localiser, noise_px=args.noise_px, roll_deg=args.roll_deg
    )
    predicted = partial(expectation_document, rig_as_planned(rig, planned), plan)
    crack = _model(PlannedCrack, args)
    document = predicted(measured, more=lambda *of: {"k1": planned_k(of[0], of[1], of[2], of[3], crack)})
    document["modulus"] = _modulus(predicted, document["views"], measured, _model(PlannedTensileTest, args))
    print(to_json(document).decode().rstrip() if args.json else table(document))
    return 1 if document["refused"] else 0


def table(document: Mapping[str, Any]) -> str:
    """Write an expectation as a table: micrometres and microstrain."""
    head = ["quantity", "after, mm", "u (k = 1)", *BUDGET]
    rows = [head]
    for one in document["quantities"]:
        unit = "ue" if one["unit"] == "1" else "um"
        scale = 1e6 if one["unit"] == "1" else 1e3
        size = "" if one["size_mm"] is None else f", {one['size_mm']:.3g} mm"
        name = one["name"] if one["of"] in ("point", "length") else f"{one['of']} {one['name']}"
        moved = "" if one["translation_mm"] is None else ", ".join(f"{v:g}" for v in one["translation_mm"])
        row = [name.removeprefix("strain ") + size, moved]
        if one["sigma"] is None:
            row += [f"- ({one['missing']})"]
        else:
            row += [f"{scale * one['sigma']:.3g} {unit}", *(f"{scale * one['budget'][c]:.3g}" for c in BUDGET)]
        rows.append(row)
    widths = [max(len(r[k]) for r in rows if len(r) == len(head)) for k in range(len(head))]
    lines = [
        "  ".join(
            cell.ljust(w) if k < 2 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=False))
        )
        for row in rows
    ]
    lines += ["", document["assumed"]["text"], document["measurement"]["text"]]
    lines += [f"{name}: {_seen(view)}" for name, view in document["views"].items()]
    lines += [_modulus_line(document["modulus"]), *_k_line(document["k1"])]
    lines += [f"would be refused: {reason}" for reason in document["reasons"]]
    return "\n".join(line.rstrip() for line in lines)


def _modulus(
    predicted: Callable[[PlannedMeasurement], Mapping[str, Any]],
    views: Any,
    measured: PlannedMeasurement,
    test: PlannedTensileTest,
) -> dict[str, Any]:
    """Return the relative standard uncertainty of a modulus whose gauge is as wide as the planned area."""
    across = 1e3 * measured.area_mm / views["cam1"]["um_per_px"]
    window = 2 * round(0.5 * (across - measured.subset_px) / measured.spacing_px) + 1
    window = min(max(window, STRAIN_WINDOW.low), STRAIN_WINDOW.high)
    wide = measured.model_copy(update={"strain_window": window})
    strains = [q for q in predicted(wide)["quantities"] if q["name"] == "exx"]
    known = [q for q in strains if q["sigma"] is not None]
    missing = [name for name in ("load_class", "section_u") if getattr(test, name) is None]
    found: dict[str, Any] = {**test.model_dump(), "gauge_mm": None, "relative_u": None, "parts": {}, "missing": missing}
    if known:
        moved = max(math.hypot(*(q["budget"][c] for c in _OF_CAMERAS)) for q in known)
        parts = modulus_parts(test, max(q["budget"]["matching"] for q in known), moved)
        whole = None if missing else math.hypot(*parts.values())
        found |= {"gauge_mm": known[0]["size_mm"], "relative_u": whole, "parts": dict(parts)}
    return found


def _modulus_line(found: Mapping[str, Any]) -> str:
    """Write the modulus' uncertainty and its parts in one line."""
    if found["gauge_mm"] is None:
        return f"modulus: no uncertainty, {_UNSEEN}"
    low, high = found["modulus_strains"]
    parts = ", ".join(f"{cause} {100.0 * u:.2g} %" for cause, u in found["parts"].items())
    whole = f"not stated: {', '.join(found['missing'])}"
    if found["relative_u"] is not None:
        whole = f"u (k = 1) {100.0 * found['relative_u']:.2g} %"
    gauge = f"{found['gauge_mm']:.3g} mm gauge, {found['modulus_steps']} steps between strains of {low:g} and {high:g}"
    return f"modulus: {whole}; {parts}; {gauge}, the body moving by the largest translation"


def _k_line(found: Mapping[str, Any]) -> list[str]:
    """Write K_I and its uncertainty in one line; nothing if no crack is planned."""
    if "crack_half_mm" in found["missing"]:
        return []
    if found["missing"]:
        return [f"K_I: not stated: {', '.join(found['missing'])}"]
    parts = ", ".join(f"{cause} {u:.2g}" for cause, u in found["parts"].items())
    return [f"K_I: {found['k1']:.4g} MPa m^0.5, u (k = 1) {found['u']:.2g}; {parts}"]


def _seen(view: Mapping[str, Any]) -> str:
    """Write what a camera sees in one line, and the values that are missing for more."""
    width, height = view["field_mm"]
    small, large = view["speckle_mm"]
    parts = [
        f"field {width:.4g} x {height:.4g} mm",
        f"{view['um_per_px']:.4g} um per px",
        f"speckle of 3 to 5 px: {small:.3g} to {large:.3g} mm",
    ]
    if view["depth_mm"] is not None:
        near, far = view["depth_mm"]
        end = "without end" if far is None else f"{far:.3g} mm farther"
        parts.append(f"blurred by less than 1 px from {near:.3g} mm nearer to {end}")
    if view["blur_px"] is not None:
        parts.append(f"blur by motion {view['blur_px']:.3g} px")
    if view["photons_at_1000_lx"] is not None:
        parts.append(f"light: {view['photons_at_1000_lx']:.3g} photons a pixel from matt white lit with 1,000 lx")
    if view["missing"]:
        parts.append(f"not stated: {', '.join(view['missing'])}")
    return "; ".join(parts)


def _base(path: Path | None, planned: PlannedRig) -> tuple[dict[str, Any], tuple[float, ...], Any]:
    """Rig, positions and localiser of the rig file; without one, of the options, all of which are then required."""
    if path is not None:
        from stereorig.server.config.rig_file import load_config
        from stereorig.server.workflows.calibration.sequence import rig_metadata

        config = load_config(path)
        return rig_metadata(config), tuple(config.calibration.positions_mm), config.calibration.localiser
    missing = [_option(name) for name in _NEEDED if getattr(planned, name) is None]
    if planned.pinhole_px is None:
        missing.append("--phd-px (or --focal-mm and --pixel-um)")
    if missing:
        raise InputError(f"Without --rig {', '.join(missing)} must be given.", remedy="Give them, or a rig file.")
    camera = {"aspect": 1.0, "standoff_mm": None, "angle_deg": None, "phd_px": None, "image_size_px": None}
    # a line's width has no part in a prediction
    target = {"line_width_mm": 0.05 * (planned.pitch_mm or 1.0)}
    rig = {"target": target, "cam1": camera, "cam2": camera, "axis_tilt_sigma_rad": 1e-3}
    return rig, (), "profile"


def _option(name: str) -> str:
    return _NAMES.get(name, "--" + name.replace("_", "-"))


def _shown(value: Any) -> str:
    return ",".join(f"{v:g}" for v in value) if isinstance(value, list | tuple) else f"{value}"


def _model(model: type[_M], args: argparse.Namespace) -> _M:
    """Return a model of the options given.

    Raises
    ------
    InputError
        If a value is no number of its range, or two disagree.
    """
    given: dict[str, Any] = {}
    for name in model.model_fields:
        text = getattr(args, name)
        if text is not None:
            numbers = _numbers(_option(name), text)
            given[name] = numbers if _takes_list(model, name) else numbers[0]
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        where = _option(str(first["loc"][0])) + ": " if first["loc"] else ""
        raise InputError(f"{where}{first['msg']}.", remedy="See stereorig expect --help.") from error


def _takes_list(model: type[BaseModel], name: str) -> bool:
    return re.search(r"list\[|tuple\[", str(model.model_fields[name].annotation)) is not None


def _numbers(option: str, text: str) -> Sequence[float]:
    try:
        numbers = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        numbers = []
    if not numbers:
        raise InputError(f"{option} {text!r} holds no numbers.", remedy="Write it as 0,5,10.")
    return [int(v) if v.is_integer() else v for v in numbers]
