"""calibration.json: both cameras with their covariance, checks and verdict.

A file that holds only ``cam1`` and ``cam2``, the eleven parameters each, is enough to measure with
(:func:`server.formats.calibrations.recognise.load_calibration` reads any of them); the rest states its uncertainty and
checks.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.calibration import COVARIANCE_NAMES, CalibrationResult, CheckMeasures, Measures
from core.errors import FileFormatError
from core.target import GridTarget
from server.formats.files import write_bytes

FORMAT_VERSION = 1


def calibration_content(
    result: CalibrationResult, target: GridTarget, *, provenance: Mapping[str, object] | None = None
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
        "cam1": result.pair.cam1.paper_parameters(),
        "cam2": result.pair.cam2.paper_parameters(),
        "image_size_px": {f"cam{c + 1}": list(n.image_size_px) for c, n in enumerate(result.nominals)},
        "covariance": {"names": list(COVARIANCE_NAMES), "matrix": result.covariance.tolist()},
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
            "predicted_shape_rms_mm": result.predicted.shape_rms_mm,
        },
        "views": [
            {
                "name": view.name,
                "camera": view.camera,
                "dz_mm": view.dz_mm,
                "held_out": view.held_out,
                "rbe_px": view.rbe_px,
                "raz_mm": view.raz_mm,
                "nsce": view.nsce,
            }
            for view in result.views
        ],
        "target": {**asdict(target), "lines": list(target.lines)},
        "node_corrections_mm": None if result.node_corrections_mm is None else result.node_corrections_mm.tolist(),
        "node_sigma_mm": None if result.node_sigma_mm is None else result.node_sigma_mm.tolist(),
        "nominal": {
            f"cam{c + 1}": {**asdict(n), "image_size_px": list(n.image_size_px)} for c, n in enumerate(result.nominals)
        },
        "settings": asdict(result.options),
        "provenance": dict(provenance or {}),
    }


def write_calibration(
    path: str | Path, result: CalibrationResult, target: GridTarget, *, provenance: Mapping[str, object] | None = None
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


def covariance_in(content: Mapping[str, object], *, name: str) -> NDArray[np.float64] | None:
    """Return the (20, 20) covariance of a calibration.json's content in the order of COVARIANCE_NAMES, None without.

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
    missing = [n for n in COVARIANCE_NAMES if n not in names]
    if missing:
        raise _unusable(name, f"its names lack {', '.join(missing)}")
    order = [names.index(n) for n in COVARIANCE_NAMES]
    matrix = matrix[np.ix_(order, order)]
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0):
        raise _unusable(name, "its matrix is not finite and symmetric")
    return matrix


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
    }
