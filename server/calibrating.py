"""The fit of a calibration, in the worker: grid in every view, adjustment, drift check, ``calibration.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import netCDF4
import numpy as np
from numpy.typing import NDArray

from core.calibration import (
    CalibrationOptions,
    CalibrationResult,
    CalibrationView,
    NominalCamera,
    calibrate,
)
from core.calibration.inputs import CAMERAS
from core.errors import CalibrationError, TargetError
from core.grid import GridOptions, GridView, detect_grid
from core.target import GridTarget
from server.io.calibration_json import calibration_content
from server.io.files import written_aside
from server.io.images import read_image
from server.store.durable import write_json
from server.tasks import FitTask
from server.version import software_version
from server.worker_process import TaskChannel, current_task

#: mean shift of the grid between the first and the last view at zero: above the first a warning, above the second no
#: calibration. The detector repeats to 0.002 px; 0.1 px of epipolar error shows as micrometres of false motion.
DRIFT_WARNING_PX = 0.05
DRIFT_REFUSED_PX = 0.1


def fit_calibration(task: FitTask) -> dict[str, Any]:
    """Find the grid in every view and fit both cameras.

    Returns
    -------
    dict
        Verdict and checks; everything else is in ``calibration.json``.

    Raises
    ------
    TargetError
        The grid was not found in a view; ``view`` and ``camera`` say where.
    CalibrationError
        No usable minimum, or ``grid_moved`` while the views were taken.
    """
    channel = current_task()
    folder = Path(task.folder)
    rig, plan = task.plan["rig"], task.plan
    target = GridTarget(**{**rig["target"], "lines": tuple(rig["target"]["lines"])})
    found = _detect_all(folder, task.views, target, plan["localiser"], channel)
    drift = _drift(task.views, found)
    views = [
        CalibrationView(
            camera=view["camera"],
            dz_mm=view["dz_mm"],
            xy_px=grid.xy_px,
            sigma_px=np.sqrt(np.mean(grid.sigma_px**2, axis=-1)),
            name=Path(view["file"]).name,
        )
        for view, grid in zip(task.views, found, strict=True)
        if view["role"] in ("fitted", "held_out")
    ]
    channel.progress("fit", 0, 1)
    options = CalibrationOptions(held_out_mm=tuple(plan["held_out_mm"]))
    result = calibrate(views, target, _nominals(rig), options)
    provenance = {
        "software_version": software_version(),
        "rig": rig["name"],
        "localiser": plan["localiser"],
        "frames": plan["frames"],
        "views_sha256": {Path(v["file"]).name: v["sha256"] for v in task.views},
    }
    content = calibration_content(result, target, provenance=provenance)
    _judge_drift(content, drift)
    _write_residuals(folder / "residuals.nc", result, views)
    write_json(folder / "calibration.json", content)
    channel.progress("fit", 1, 1)
    return {
        "verdict": content["verdict"],
        "checks": {k: _three(content["checks"][k]) for k in ("fitted", "held_out")},
        "drift_px": drift,
    }


def _detect_all(
    folder: Path,
    views: list[dict[str, Any]],
    target: GridTarget,
    localiser: Literal["profile", "paper"],
    channel: TaskChannel,
) -> list[GridView]:
    # an adjustment that solves for the maker's errors needs to see them: no smoothing along whole lines
    local = localiser == "profile" and target.node_tolerance_mm > 0.0
    found = []
    for index, view in enumerate(views):
        channel.check()
        channel.progress("grid", index, len(views))
        options = GridOptions(line_model="local" if local else None, saturation=float(view["full_scale"]))
        try:
            found.append(detect_grid(read_image(folder / view["file"]), target, localiser=localiser, options=options))
        except TargetError as error:
            error.cause = f"{view['camera']} at dZ = {view['dz_mm']:+.3f} mm: {error.cause}"
            error.context |= {"camera": view["camera"], "view": view["index"], "dz_mm": view["dz_mm"]}
            raise
    channel.progress("grid", len(views), len(views))
    return found


def _nominals(rig: dict[str, Any]) -> tuple[NominalCamera, NominalCamera]:
    one, two = (
        NominalCamera(
            image_size_px=tuple(rig[cam]["image_size_px"]),
            phd_px=rig[cam]["phd_px"],
            standoff_mm=rig[cam]["standoff_mm"],
            angle_deg=rig[cam]["angle_deg"],
            aspect=rig[cam]["aspect"],
        )
        for cam in CAMERAS
    )
    return one, two


def _drift(views: list[dict[str, Any]], found: list[GridView]) -> dict[str, float]:
    """Mean shift of the intersections between the first and the last view at zero, per camera."""
    drift: dict[str, float] = {}
    for cam in CAMERAS:
        at_zero = [g for v, g in zip(views, found, strict=True) if v["camera"] == cam and v["dz_commanded_mm"] == 0.0]
        shift = np.nanmean(at_zero[-1].xy_px - at_zero[0].xy_px, axis=(0, 1))
        drift[cam] = float(np.hypot(*shift))
    return drift


def _judge_drift(content: dict[str, Any], drift: dict[str, float]) -> None:
    """Add the drift to the content's checks and verdict.

    Raises
    ------
    CalibrationError
        ``grid_moved``.
    """
    worst = max(drift, key=lambda cam: drift[cam])
    text = f"back at zero, the grid lies {drift[worst]:.4f} px from where {worst} first saw it"
    if drift[worst] > DRIFT_REFUSED_PX:
        raise CalibrationError(
            f"The grid or a camera moved while the views were taken: {text}.",
            code="grid_moved",
            remedy="Fix grid and cameras, let them come to the room's temperature, then calibrate again.",
            drift_px=drift,
        )
    content["checks"]["drift_px"] = drift
    content["checks"]["made"].append({"name": "drift", "made": True, "text": text})
    if drift[worst] > DRIFT_WARNING_PX:
        verdict = content["verdict"]
        verdict["level"] = "warning" if verdict["level"] == "good" else verdict["level"]
        verdict["reasons"] = [*verdict["reasons"], f"{text}: something moved"]


def _three(check: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if check is None else {k: check[k] for k in ("rbe_px", "raz_mm", "nsce")}


def _write_residuals(path: Path, result: CalibrationResult, views: list[CalibrationView]) -> None:
    """Write where each intersection was found and by how much the model misses it, (view, i, j, xy)."""
    by_name = {view.name: view for view in views}
    residuals = np.stack([view.residual_px for view in result.views])
    found = np.stack([np.asarray(by_name[view.name].xy_px) for view in result.views])
    facts = [
        {
            "name": v.name, "camera": v.camera, "dz_mm": v.dz_mm, "held_out": v.held_out,
            "rbe_px": v.rbe_px, "raz_mm": v.raz_mm, "nsce": v.nsce,
        }
        for v in result.views
    ]  # fmt: skip
    with written_aside(path) as aside, netCDF4.Dataset(str(aside), "w", format="NETCDF4_CLASSIC") as data:
        for name, size in zip(("view", "i", "j", "xy"), residuals.shape, strict=True):
            data.createDimension(name, size)
        _put(data, "found_px", found, "place of the intersection in the image")
        _put(data, "residual_px", residuals, "measured minus projected place")
        data.setncatts({"views": json.dumps(facts), "title": "residuals of a calibration"})


def _put(data: Any, name: str, values: NDArray[np.float64], text: str) -> None:
    variable = data.createVariable(name, "f8", ("view", "i", "j", "xy"), compression="zlib", fill_value=np.nan)
    variable.setncatts({"units": "pixel", "long_name": text})
    variable[...] = values
