"""calibration.json of a repaired pair: camera 2's pose and the entries that depend on it are new, all others kept."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.calibration.uncertainty import volume_uncertainty
from stereorig.core.cameras.camera import POSE_NAMES, Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from stereorig.core.orientation import RepairedPair, RepairLimits
from stereorig.core.orientation.change import CHANGE_NAMES
from stereorig.core.orientation.propagate import carried_parameters, pose_parameters, repaired_covariance
from stereorig.server.formats.calibrations.export import convert_calibration
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, parse_calibration
from stereorig.server.formats.calibrations.record import CalibrationRecord
from stereorig.server.formats.calibrations.volume import target_of
from stereorig.server.formats.results.summary import to_json
from stereorig.server.formats.version import software_version

_STEP = 1e-3  # of a parameter's standard uncertainty


def native_content(loaded: LoadedCalibration, original: bytes) -> dict[str, Any]:
    """Return a calibration as this program keeps it, with the poses by their names.

    Raises
    ------
    CalibrationError
        ``lens_unfittable`` where an imported pair sees nothing in common.
    """
    if not loaded.imported:
        return copy.deepcopy(loaded.details)
    content: dict[str, Any] = json.loads(convert_calibration(loaded, "paper", original).data)
    # in the frame of that form, whose origin is in front of the cameras, with the lenses as they were
    framed = parse_calibration(to_json(content), name="The calibration").pair
    for cam, camera, placed in zip(
        CAMERAS, (loaded.pair.cam1, loaded.pair.cam2), (framed.cam1, framed.cam2), strict=True
    ):
        content[cam] = Camera(camera.lens, placed.cam_from_sys).values()
    return content


def repaired_content(
    content: Mapping[str, Any],
    original_sha256: str,
    repair: RepairedPair,
    images: Sequence[Mapping[str, Any]],
    limits: RepairLimits,
) -> dict[str, Any]:
    """Return the content of the repaired calibration.json.

    Parameters
    ----------
    content
        Content of the old calibration.json, from :func:`native_content`.
    original_sha256
        SHA-256 of the old file's bytes.
    repair
        Made with the pair of ``content``.
    images
        File names and SHA-256 of the images, by camera, a step each.
    limits
        The limits that the repair was checked against.
    """
    out: dict[str, Any] = copy.deepcopy(dict(content))
    out["cam2"] |= dict(zip(POSE_NAMES, pose_parameters(repair.pair).tolist(), strict=True))
    covariance = _covariance(content, repair)
    if covariance is not None:
        names, matrix, whole = covariance
        out["covariance"] = {**out["covariance"], "matrix": matrix.tolist()}
        if isinstance(out.get("covariance_by_cause"), dict):
            out["covariance_by_cause"] = _by_cause(out["covariance_by_cause"], matrix, whole)
        sigma = dict(zip(names, np.sqrt(np.maximum(np.diagonal(matrix), 0.0)).tolist(), strict=True))
        if isinstance(out.get("sigma"), dict):
            out["sigma"] = {name: sigma.get(name, value) for name, value in out["sigma"].items()}
        out["uncertainty"] = _uncertainty(out, repair.pair, names, matrix)
    section = repair_section(repair, limits)
    out["repair"] = {
        **section,
        "images": [dict(one) for one in images],
        "original_sha256": original_sha256,
        "software_version": software_version(),
        "earlier": content.get("repair"),
    }
    old = out.get("verdict")
    verdict: dict[str, Any] = old if isinstance(old, dict) else {}
    level = "failed" if verdict.get("level") == "failed" else "warning"
    out["verdict"] = {**verdict, "level": level, "reasons": [*verdict.get("reasons", []), section["text"]]}
    return out


def repair_section(repair: RepairedPair, limits: RepairLimits) -> dict[str, object]:
    """Return the finding of a repair as plain values."""
    sigma = np.sqrt(np.diagonal(repair.estimate.covariance))
    turn = float(np.degrees(np.linalg.norm(repair.change[:3])))
    cost = repair.consequence
    return {
        "text": f"camera 2's orientation against camera 1 was estimated again from the speckle, {turn:.3f} degrees "
        f"from the calibration's, with the baseline's length kept: strains of shapes are known to "
        f"{cost.strain_sigma_microstrain:.2g} microstrain from it",
        "estimated": list(CHANGE_NAMES),
        "change_deg": np.degrees(repair.change).tolist(),
        "change_sigma_deg": np.degrees(sigma).tolist(),
        "change_covariance_rad2": repair.estimate.covariance.tolist(),
        "determined": repair.estimate.determined,
        "points": len(repair.points.xy1_px),
        "noise_px": repair.estimate.noise_px,
        "offset_before_px": repair.before_px,
        "offset_after_px": repair.after_px,
        "structure_px": repair.structure_px,
        "baseline_mm": repair.pair.baseline_mm,
        "baseline_sigma_mm": repair.length_sigma * repair.pair.baseline_mm,
        "consequence": cost.document(),
        "limits": vars(limits),
    }


def _by_cause(parts: Mapping[str, Any], matrix: NDArray[np.float64], whole: NDArray[np.float64]) -> dict[str, object]:
    """Parts by cause of the repaired parameters' covariance: the estimate adds noise, to the part ``calibration``."""
    out = {
        cause: whole @ np.asarray(part, dtype=np.float64) @ whole.T
        for cause, part in parts.items()
        if cause != "calibration"
    }
    rest = matrix - np.sum(list(out.values()), axis=0) if out else matrix
    return {cause: part.tolist() for cause, part in ({"calibration": rest} | out).items()}


def _covariance(
    content: Mapping[str, Any], repair: RepairedPair
) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]] | None:
    """Names, covariance of the repaired parameters, and their slopes over the old; None where the old file has none."""
    part = content.get("covariance")
    if not isinstance(part, dict):
        return None
    names, matrix = list(part["names"]), np.asarray(part["matrix"], dtype=np.float64)
    pose = [f"cam2.{name}" for name in POSE_NAMES]
    if any(name not in names for name in pose):
        return None
    steps = np.where(np.diagonal(matrix) > 0.0, _STEP * np.sqrt(np.maximum(np.diagonal(matrix), 0.0)), 1e-9)
    stepped = [
        (_stepped(content, name, step), _stepped(content, name, -step)) for name, step in zip(names, steps, strict=True)
    ]
    index = [names.index(name) for name in pose]
    whole = carried_parameters(repair, stepped, steps, index)
    return names, repaired_covariance(repair, matrix, stepped, steps, index), whole


def _stepped(content: Mapping[str, Any], name: str, step: float) -> StereoPair:
    """The pair of a file in which one parameter, ``cam1.phd_px``, has another value."""
    camera, _, parameter = name.partition(".")
    changed = {
        key: content[key] for key in content if key not in ("covariance", "covariance_by_cause", "views", "repair")
    }
    if camera in CAMERAS and parameter in content[camera]:
        changed[camera] = {**content[camera], parameter: content[camera][parameter] + step}
    return parse_calibration(json.dumps(changed).encode(), name="The calibration").pair


def _uncertainty(
    content: Mapping[str, Any], pair: StereoPair, names: Sequence[str], matrix: NDArray[np.float64]
) -> dict[str, Any]:
    """Return the new entry ``uncertainty``; numbers that cannot be computed again are None."""
    old = content.get("uncertainty") if isinstance(content.get("uncertainty"), dict) else {}
    assert isinstance(old, dict)
    out = {**old, **dict.fromkeys(("shape_rms_mm", "scale", "centre_z_mm", "corner_z_mm"))}
    target = target_of(CalibrationRecord.model_validate(content).target)
    if target is None:
        return out
    found = volume_uncertainty(pair, matrix, target, names)
    return out | {
        "shape_rms_mm": found.shape_rms_mm,
        "scale": found.scale,
        "centre_z_mm": found.centre_z_mm,
        "corner_z_mm": found.corner_z_mm,
    }
