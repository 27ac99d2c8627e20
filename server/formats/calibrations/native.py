"""calibration.json: both cameras with their covariance, checks and verdict.

A file that holds only ``cam1`` and ``cam2``, the eleven parameters each, is enough to measure with
(:func:`stereorig.server.formats.calibrations.recognise.load_calibration` reads any of them); the rest states its
uncertainty and checks.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import COVARIANCE_NAMES, CalibrationResult, CheckMeasures, Measures, ViewResult
from stereorig.core.cameras.camera import POSE_NAMES, Camera, RigidTransform
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import FileFormatError
from stereorig.core.names import CAMERAS, CAUSES, Cause
from stereorig.core.target import LINE_GRID, GridTarget
from stereorig.server.formats.files import write_bytes

FORMAT_VERSION = 1


def calibration_content(
    result: CalibrationResult, target: GridTarget | BoardTarget, *, provenance: Mapping[str, object] | None = None
) -> dict[str, Any]:
    """Return the content of calibration.json as plain numbers, lists and texts.

    Parameters
    ----------
    result
        The calibration.
    target
        The target of the calibration.
    provenance
        Further entries to keep (software version, localiser, hashes of the views); nothing is computed from them.
    """
    return {
        "format": "stereorig calibration",
        "format_version": FORMAT_VERSION,
        "cam1": result.pair.cam1.values(),
        "cam2": result.pair.cam2.values(),
        "lens": {
            "model": result.lens.model,
            "reasons": list(result.lens.reasons),
            "structure": [
                {
                    "name": found.name,
                    "camera": found.camera,
                    "terms": {name: {"value": v, "sigma": s} for name, (v, s) in found.terms.items()},
                    "probability": found.probability,
                    "rms_px": found.rms_px,
                }
                for found in result.lens.structure
            ],
        },
        "stage": _stage(result),
        "pitch_scale": {"value": result.pitch_scale, "sigma": result.pitch_scale_sigma},
        "image_size_px": {f"cam{c + 1}": list(n.image_size_px) for c, n in enumerate(result.nominals)},
        "covariance": {"names": list(result.names), "matrix": result.covariance.tolist()},
        "covariance_by_cause": {cause: part.tolist() for cause, part in result.covariance_by_cause.items()},
        "sigma": result.sigma,
        "noise_px": _by_camera(result.noise_px),
        "redundancy": _by_camera(result.redundancy),
        "axis_tilt_rad": _by_camera(result.axis_tilt_rad),
        "axis_tilt_sigma_rad": _by_camera(result.axis_tilt_sigma_rad),
        "checks": {
            "fitted": _measures(result.fitted),
            "held_out": None if result.held_out is None else _measures(result.held_out),
            "made": [asdict(check) for check in result.checks],
        },
        "verdict": {"level": result.verdict.level, "reasons": list(result.verdict.reasons)},
        "uncertainty": {
            "shape_rms_mm": result.uncertainty.shape_rms_mm,
            "scale": result.uncertainty.scale,
            "centre_z_mm": result.uncertainty.centre_z_mm,
            "corner_z_mm": result.uncertainty.corner_z_mm,
            "predicted_shape_rms_mm": None if result.predicted is None else result.predicted.shape_rms_mm,
        },
        "views": [{**view_record(view), "cam_from_target": pose_record(view.cam_from_target)} for view in result.views],
        "dropped": [asdict(view) for view in result.dropped],
        "target": target_record(target),
        "node_corrections_mm": None if result.node_corrections_mm is None else result.node_corrections_mm.tolist(),
        "node_sigma_mm": None if result.node_sigma_mm is None else result.node_sigma_mm.tolist(),
        "nominal": {
            f"cam{c + 1}": {**asdict(n), "image_size_px": list(n.image_size_px)} for c, n in enumerate(result.nominals)
        },
        "settings": asdict(result.options),
        "provenance": dict(provenance or {}),
    }


def target_record(target: GridTarget | BoardTarget) -> dict[str, Any]:
    """Return a target's description as plain values, its kind among them."""
    kind = {"kind": LINE_GRID} if isinstance(target, GridTarget) else {}
    fields = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(target).items()}
    if not any(fields.get("missing_lines", ())):
        fields.pop("missing_lines", None)
    return {**kind, **fields}


def view_record(view: ViewResult) -> dict[str, Any]:
    """Return a view's name, place and measures."""
    return {
        "name": view.name,
        "camera": view.camera,
        "dz_mm": view.dz_mm,
        "frame": view.frame,
        "held_out": view.held_out,
        "rbe_px": view.rbe_px,
        "raz_mm": view.raz_mm,
        "nsce": view.nsce,
    }


def pose_record(pose: RigidTransform) -> dict[str, list[float]]:
    """Return a pose as a rotation vector and a translation."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    return {
        "rotation_vector_rad": Rotation.from_matrix(pose.rotation).as_rotvec().tolist(),
        "translation_mm": pose.translation_mm.tolist(),
    }


def _stage(result: CalibrationResult) -> dict[str, Any]:
    found = result.stage
    return {
        "moves": found.moves,
        "direction_sys": None if found.direction_sys is None else found.direction_sys.tolist(),
        "direction_sigma_rad": None if found.direction_sigma_rad is None else found.direction_sigma_rad.tolist(),
        "scale": found.scale.tolist(),
        "scale_sigma": found.scale_sigma.tolist(),
        "steps": [{"axis": a, "dz_mm": dz, "error_mm": e, "sigma_mm": s} for a, dz, e, s in found.steps],
    }


def write_calibration(
    path: str | Path,
    result: CalibrationResult,
    target: GridTarget | BoardTarget,
    *,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """Write calibration.json as a temporary file, sync it and rename it.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    content = calibration_content(result, target, provenance=provenance)
    # JSON has no numbers that are not finite, and a calibration must not have any
    write_bytes(Path(path), (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def covariance_in(
    content: Mapping[str, object], *, name: str, pair: StereoPair
) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
    """Return the covariance (n, n) of a calibration.json's content and its parameters' names, None without.

    Takes and raises the same as :func:`parameters_in`.
    """
    found = parameters_in(content, name=name, pair=pair)
    return None if found is None else (tuple(found.names), found.covariance)


def parameters_in(content: Mapping[str, object], *, name: str, pair: StereoPair) -> ParameterCovariance | None:
    """Return the covariance of a calibration.json's content with its parts by cause, None without.

    Parameters
    ----------
    content
        Content of the calibration.json.
    name
        Name of the file, for messages.
    pair
        The file's cameras: the covariance's names must be names of their parameters.

    Raises
    ------
    FileFormatError
        Code ``calibration_unreadable`` if it is there but not usable.
    """
    part = content.get("covariance")
    if part is None:
        return None
    if not isinstance(part, Mapping) or not isinstance(part.get("names"), list):
        raise _unusable(name, "it has no names")
    names = part["names"]
    try:
        matrix = np.asarray(part.get("matrix"), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _unusable(name, "its matrix holds something else than numbers") from error
    if matrix.shape != (len(names), len(names)):
        raise _unusable(name, f"its matrix is {matrix.shape} for {len(names)} names")
    cameras = dict(zip(CAMERAS, (pair.cam1, pair.cam2), strict=True))
    needed = [f"{cam}.{key}" for cam, camera in cameras.items() for key in _needed(camera)]
    missing = [n for n in needed if n not in names]
    if missing:
        raise _unusable(name, f"its names lack {', '.join(missing)}")
    known = {f"{cam}.{key}" for cam, camera in cameras.items() for key in camera.parameter_names}
    # the usual order for the paper's lens, so that equal files give equal sums
    order = [n for n in COVARIANCE_NAMES if n in names]
    order = (
        [*order, *(n for n in names if n in known and n not in order)]
        if len(order) == len(COVARIANCE_NAMES)
        else [n for n in names if n in known]
    )
    index = [names.index(n) for n in order]
    matrix = matrix[np.ix_(index, index)]
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0):
        raise _unusable(name, "its matrix is not finite and symmetric")
    return ParameterCovariance(pair, tuple(order), matrix, _by_cause(content, names, index, name=name))


def _by_cause(
    content: Mapping[str, object], names: Sequence[str], index: Sequence[int], *, name: str
) -> dict[Cause, NDArray[np.float64]] | None:
    """Parts of the covariance by cause, in its order; None if the file does not separate them."""
    part = content.get("covariance_by_cause")
    if part is None:
        return None
    if not isinstance(part, Mapping) or not part or any(cause not in CAUSES for cause in part):
        raise _unusable(name, f"covariance_by_cause must have parts of {', '.join(CAUSES)}")
    out: dict[Cause, NDArray[np.float64]] = {}
    for cause in CAUSES:
        if cause not in part:
            continue
        try:
            matrix = np.asarray(part[cause], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise _unusable(name, f"its part of {cause} holds something else than numbers") from error
        if matrix.shape != (len(names), len(names)) or not np.isfinite(matrix).all():
            raise _unusable(name, f"its part of {cause} is no finite matrix for {len(names)} names")
        out[cause] = matrix[np.ix_(index, index)]
    return out


def _needed(camera: Camera) -> tuple[str, ...]:
    if isinstance(camera.lens, SeidelLens):
        return ("phd_px", "cx_px", "cy_px", "kappa_per_px2", *POSE_NAMES)
    return ("fx_px", "fy_px", "cx_px", "cy_px", *POSE_NAMES)


def _unusable(name: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"The covariance in {name} cannot be used: {why}.",
        code="calibration_unreadable",
        remedy="Calibrate again, or take the covariance out of the file.",
    )


def _by_camera(values: NDArray[np.float64]) -> dict[str, list[float] | float]:
    return {f"cam{c + 1}": v.tolist() if np.ndim(v) else float(v) for c, v in enumerate(values)}


def _three(measures: Measures) -> dict[str, float]:
    return {"rbe_px": measures.rbe_px, "raz_mm": measures.raz_mm, "nsce": measures.nsce, "points": measures.count}


def _measures(check: CheckMeasures) -> dict[str, object]:
    return {
        **_three(check.mean),
        "per_camera": {f"cam{c + 1}": _three(m) for c, m in enumerate(check.per_camera)},
        "against_nominal_grid": {
            **_three(check.nominal_mean),
            "per_camera": {f"cam{c + 1}": _three(m) for c, m in enumerate(check.nominal_per_camera)},
        },
        "positions_mm": {f"cam{c + 1}": list(p) for c, p in enumerate(check.positions_mm)},
        "frames": {f"cam{c + 1}": list(p) for c, p in enumerate(check.frames)},
    }
