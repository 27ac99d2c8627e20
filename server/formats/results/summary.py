"""What one field comes to in a few numbers, for ``summary.json`` and the API."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.field.checks.epipolar_offset import check_epipolar
from core.field.points.result import Field
from core.status import PointStatus
from server.formats.results.layout import COMPARISONS


def plane_residuals_mm(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distances (n,) of points (n, 3) from their best-fit plane (least squares of the normal distances)."""
    centred = points_mm - points_mm.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    return np.asarray(centred @ normal)


def _rms(values: NDArray[np.float64]) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def summarise(result: Field, *, rbe_px: float | None = None, reference: int = 0) -> dict[str, Any]:
    """Summarise one field.

    Parameters
    ----------
    result
        The field.
    rbe_px
        The calibration's own reprojection error, where it is known.
    reference
        Number of the sequence's reference.

    Returns
    -------
    dict
        ``points`` (in the region), ``valid``, ``valid_fraction``, ``status`` (counts by name), then of the full offset
        across the epipolar line in camera 2, ``epipolar_px``: ``epipolar_offset_mean_px`` (what the calibration is
        off), ``epipolar_offset_rms_px`` and ``epipolar_offset_sd_px`` (about the mean); ``epipolar_residual_rms_px``
        (the error left in each image when both cameras share the misfit equally: half of
        ``epipolar_offset_rms_px``), ``epipolar_check`` (whether the cameras still stand as calibrated, see
        :class:`EpipolarCheck`), ``plane_residual_rms_mm`` (of the reference positions),
        ``zncc_median`` and ``sigma_median_mm``, ``patch`` (what the field was measured with, why, and the numbers of
        the choice; see :class:`PatchChoice`), ``smoothing`` (how the displacement was smoothed and
        what can still be told apart; see :class:`core.field.points.smoothing_record.Smoothing`), for displacements also
        ``displacement_mm`` (mean, min, max of u, v, w), ``reference_step`` (what the step was matched against) and
        ``points_by_reference`` (valid points by what they were matched against).
        What cannot be told is None.
    """
    status = result.status
    valid = result.valid
    points = int((status != PointStatus.MASKED).sum())
    n = int(valid.sum())
    epipolar = result.epipolar_px[valid]
    check = check_epipolar(result, rbe_px)
    names = ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")[: result.covariance.shape[-1]]
    summary: dict[str, Any] = {
        "kind": "displacement" if result.has_motion else "shape",
        "points": points,
        "valid": n,
        "valid_fraction": n / points if points else None,
        "status": {s.name.lower(): int((status == s).sum()) for s in PointStatus if (status == s).any()},
        "epipolar_offset_mean_px": float(epipolar.mean()) if n else None,
        "epipolar_offset_rms_px": _rms(epipolar),
        "epipolar_offset_sd_px": float(epipolar.std()) if n else None,
        "epipolar_residual_rms_px": _rms(epipolar / 2),
        "epipolar_check": None if check is None else check.document(),
        "plane_residual_rms_mm": _rms(plane_residuals_mm(result.xyz_mm[valid])) if n >= 4 else None,
        "zncc_median": {
            name: float(np.median(result.zncc[valid][:, k])) if n else None
            for k, name in enumerate(COMPARISONS[: result.zncc.shape[-1]])
        },
        "sigma_median_mm": {
            name: float(np.sqrt(np.median(result.covariance[valid][:, k, k]))) if n else None
            for k, name in enumerate(names)
        },
    }
    summary["smoothing"] = None if result.smoothing is None else result.smoothing.document()
    summary["patch"] = None if result.patch is None else result.patch.document()
    if result.uvw_mm is not None:
        matched = result.references
        summary["reference_step"] = reference if matched is None else matched.step
        steps, counts = np.unique(
            np.full(n, reference) if matched is None else matched.steps[valid], return_counts=True
        )
        summary["points_by_reference"] = {str(k): int(c) for k, c in zip(steps, counts, strict=True)}
        uvw = result.uvw_mm[valid]
        summary["displacement_mm"] = {
            name: {"mean": float(a.mean()), "min": float(a.min()), "max": float(a.max())} if n else None
            for name, a in zip(("u", "v", "w"), uvw.T, strict=True)
        }
    return summary


def to_json(document: Any) -> bytes:
    """Return a document as JSON text; numbers that are not finite become null."""
    return (json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value
