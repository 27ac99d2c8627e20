"""The fit of a calibration, in the worker: target in every view, adjustment, drift check, ``calibration.json``."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.boards import BoardView, detect_target
from stereorig.core.calibration import CalibrationResult
from stereorig.core.calibration.from_images import ImageOfTarget, calibrate_views
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.grid import GridOptions, GridView
from stereorig.core.names import CAMERAS
from stereorig.server.compute.calibration.inputs import nominals_of, options_of, target_of
from stereorig.server.compute.grid_kernels import await_grid_kernels
from stereorig.server.compute.tasks import FitTask, Plain
from stereorig.server.formats.calibrations.native import calibration_content, view_record
from stereorig.server.formats.images import GrayImage, read_image
from stereorig.server.formats.results.netcdf import written_dataset
from stereorig.server.formats.version import software_version
from stereorig.server.store.calibrations import REJECTED
from stereorig.server.store.durable import write_json
from stereorig.server.worker.process import current_task

TargetView = GridView | BoardView

#: mean shift of the grid between the first and the last view at zero: above the first a warning, above the second no
#: calibration. The detector repeats to 0.002 px; 0.1 px of epipolar error shows as micrometres of false motion.
DRIFT_WARNING_PX = 0.05
MAX_DRIFT_PX = 0.1


def fit_calibration(task: FitTask) -> Plain:
    """Find the target in every view and fit both cameras.

    Returns
    -------
    dict
        Verdict and checks; everything else is in ``calibration.json``.

    Raises
    ------
    TargetError
        The target was not found in a view; ``view`` and ``camera`` name the image.
    CalibrationError
        No usable minimum, ``calibration_rejected`` by its verdict, or ``grid_moved`` while the views were taken.
    """
    channel = current_task()
    folder = Path(task.folder)
    rig, plan = task.plan["rig"], task.plan
    target = target_of(rig["target"])
    await_grid_kernels(target)
    measured = [view for view in task.views if view["role"] in ("fitted", "held_out", "free")]
    # averages are scaled: the type's maximum is not the level at which the sensor saturates
    if not task.views:
        raise CalibrationInputError(
            "No view was taken.",
            code="too_few_poses",
            remedy="Take at least three views with the target tilted differently, better fifteen.",
        )
    grid_options = GridOptions(saturation=float(min(view["full_scale"] for view in task.views)))
    found = calibrate_views(
        [
            ImageOfTarget(
                view["camera"],
                view["dz_mm"],
                read_image(folder / view["file"]),
                Path(view["file"]).name,
                view["index"] if view["role"] == "free" else None,
            )
            for view in measured
        ],
        target,
        nominals_of(rig),
        options_of(rig, held_out_mm=tuple(plan.get("held_out_mm", ())), moves=plan.get("moves")),
        localiser=plan["localiser"],
        grid_options=grid_options,
        progress=channel.progress,
        cancel=channel,
    )
    known = {view["file"]: seen for view, seen in zip(measured, found.grids, strict=True) if seen is not None}
    line_model = next((g.line_model for g in known.values() if isinstance(g, GridView)), None)
    like = replace(grid_options, line_model=line_model)
    drift = _drift(
        folder, task.views, known, lambda image: detect_target(image, target, localiser=plan["localiser"], options=like)
    )
    provenance: dict[str, Any] = {
        "software_version": software_version(),
        "rig": rig["name"],
        "localiser": plan["localiser"],
        "line_model": line_model,
        "frames": plan["frames"],
        "views_sha256": {Path(v["file"]).name: v["sha256"] for v in task.views},
        "cameras": {view["camera"]: view["device"] for view in task.views if "device" in view},
    }
    if "simulated" in rig:
        provenance["simulated"] = rig["simulated"]
    content = calibration_content(found.result, target, provenance=provenance)
    _check_drift(content, drift)
    _check_positions(content, provenance.get("simulated", []), moves=plan.get("moves") or rig.get("moves"))
    _write_residuals(folder / "residuals.nc", found.result, {Path(f).name: grid for f, grid in known.items()})
    if content["verdict"]["level"] == "failed":
        write_json(folder / REJECTED, content)
        found.result.verdict.check()
    write_json(folder / "calibration.json", content, checksum=True)
    return {
        "verdict": content["verdict"],
        "checks": {k: _three(content["checks"][k]) for k in ("fitted", "held_out")},
        "drift_px": drift,
    }


def _drift(
    folder: Path, views: list[Plain], known: dict[str, TargetView], detect: Callable[[GrayImage], TargetView]
) -> dict[str, float]:
    """Return the mean shift of the points between the first and the last view at zero, per camera; empty without."""
    drift: dict[str, float] = {}
    for cam in CAMERAS:
        at_zero = [v["file"] for v in views if v["camera"] == cam and v.get("dz_commanded_mm") == 0.0]
        if not at_zero:
            continue
        first, last = (
            known[file] if file in known else detect(read_image(folder / file)) for file in (at_zero[0], at_zero[-1])
        )
        shift = np.nanmean(last.xy_px - first.xy_px, axis=(0, 1))
        drift[cam] = float(np.hypot(*shift))
    return drift


def _check_drift(content: dict[str, Any], drift: dict[str, float]) -> None:
    """Add the drift to the content's checks and verdict.

    Raises
    ------
    CalibrationError
        ``grid_moved``.
    """
    if not drift:
        return
    worst = max(drift, key=lambda cam: drift[cam])
    text = f"Back at zero, the grid is {drift[worst]:.4f} px from where {worst} first saw it."
    if drift[worst] > MAX_DRIFT_PX:
        raise CalibrationError(
            f"The grid or a camera moved while the views were taken. {text}",
            code="grid_moved",
            remedy="Fix grid and cameras, let them come to the room's temperature, then calibrate again.",
            drift_px=drift,
        )
    content["checks"]["drift_px"] = drift
    content["checks"]["made"].append({"name": "drift", "made": True, "text": text})
    if drift[worst] > DRIFT_WARNING_PX:
        _warn(content, f"{text} At most {DRIFT_WARNING_PX:g} px are good: the grid or a camera moved.")


def _check_positions(content: dict[str, Any], simulated: Sequence[str], *, moves: str | None) -> None:
    """Add a warning if real cameras were calibrated by positions of a simulated stage, at which nothing was."""
    if "stage" in simulated and not set(CAMERAS) <= set(simulated) and moves != "free":
        _warn(content, "The stage is simulated, the cameras are real: nothing moved to the positions that were fitted.")


def _warn(content: dict[str, Any], reason: str) -> None:
    verdict = content["verdict"]
    verdict["level"] = "warning" if verdict["level"] == "good" else verdict["level"]
    verdict["reasons"] = [*verdict["reasons"], reason]


def _three(check: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if check is None else {k: check[k] for k in ("rbe_px", "raz_mm", "nsce")}


def _write_residuals(path: Path, result: CalibrationResult, grids: dict[str, TargetView]) -> None:
    """Write each point's position and its residual, (view, i, j, xy), NaN if it was not found."""
    residuals = np.stack([view.residual_px for view in result.views])
    found = np.stack([grids[view.name].xy_px for view in result.views])
    view_records = [view_record(v) for v in result.views]
    with written_dataset(path, checksum=True) as data:
        for name, size in zip(("view", "i", "j", "xy"), residuals.shape, strict=True):
            data.createDimension(name, size)
        _put(data, "found_px", found, "position of the point in the image")
        _put(data, "residual_px", residuals, "measured minus projected position")
        data.setncatts({"views": json.dumps(view_records), "title": "residuals of a calibration"})


def _put(data: Any, name: str, values: NDArray[np.float64], text: str) -> None:
    variable = data.createVariable(name, "f8", ("view", "i", "j", "xy"), compression="zlib", fill_value=np.nan)
    variable.setncatts({"units": "pixel", "long_name": text})
    data.put(variable, values)
