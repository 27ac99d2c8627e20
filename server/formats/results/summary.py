"""Summary of a field in a few numbers, for ``summary.json`` and the API."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from stereorig.core.common.factor import Causes
from stereorig.core.field.checks.epipolar_offset import EpipolarCheck, check_epipolar
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import Smoothing
from stereorig.core.robust import median
from stereorig.core.status import PointStatus
from stereorig.server.formats.results.budgets import field_budgets, spread_points
from stereorig.server.formats.results.camera_motion import MotionCheck
from stereorig.server.formats.results.layout import COMPARISONS, FORMAT_VERSION
from stereorig.server.formats.results.uncertainty import Included

if TYPE_CHECKING:
    from stereorig.core.field.seeding.specimen import Specimen


ROWS_APART = "rows_apart"
"""Attribute of a result file whose images have rows of two moments: the finding in words."""


def plane_residuals_mm(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distances (n,) of points (n, 3) from their best-fit plane (least squares of the normal distances)."""
    centred = points_mm - points_mm.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    return np.asarray(centred @ normal)


def _rms(values: NDArray[np.float64]) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


@dataclass(frozen=True)
class Span:
    """Mean, minimum and maximum of a displacement's component, mm."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class StepSummary:
    """One field in a few numbers; unknown values are None.

    Attributes
    ----------
    kind
        ``shape`` or ``displacement``.
    points, valid, valid_fraction
        Points in the region, points with numbers, and the share of the latter.
    status
        Counts by the state's name.
    epipolar_offset_mean_px, epipolar_offset_rms_px, epipolar_offset_sd_px
        Full offset across the epipolar line in camera 2, ``epipolar_px``: its mean (the calibration's error
        across it), its root mean square, its standard deviation about the mean.
    epipolar_residual_rms_px
        The error left in each image when both cameras share the misfit equally: half of ``epipolar_offset_rms_px``.
    epipolar_check
        Check that the cameras are still as calibrated.
    camera_motion
        Result of the check that neither camera moved since the calibration, the reference or the step before
        (`camera_moved`, `text`), with the offset's size, pattern, significance and consequence, against each.
    plane_residual_rms_mm
        Root mean square of the reference positions' distances from their plane.
    zncc_median, sigma_median_mm
        ZNCC by comparison, and standard uncertainty by coordinate (``x_mm`` ...).
    sigma_calibration_median_mm
        The calibration's part of it; None if it is not known, and then not included.
    budget_median_mm
        By coordinate, the medians of the parts of the standard uncertainty (of large fields over 2,000 points):
        `matching`, `reference` (noise of the reference pair, common to all steps), `calibration`, `stage`, `target`. A
        part that cannot be separated is left out, and contained in the part before it.
    uncertainty_includes
        The included terms in words; ``calibration not included`` if so.
    smoothing
        Smoothing of the displacement, and its spatial resolution.
    patch
        The patch of the measurement, with the reason and the numbers of the choice.
    failed_seeds_px
        (x, y) of given seeds that did not match, though the step was measured from others; left out if all matched.
    systematic
        Errors outside the standard uncertainties: `interpolation` (of sharp texture), `patch_order`, `strain_window`,
        each with `text` (how it was estimated, or why it cannot be estimated) and `figures` by quantity and unit: `rms`
        and `largest` over the points (null if noise hides them), and the bound that the rms is `below`; null if it was
        not estimated.
        estimated.
    reference_step, points_by_reference, displacement_mm
        For displacements only: the step that this one was matched against, valid points by the step that each was
        matched against, and the components' spans.
    """

    kind: Literal["shape", "displacement"]
    points: int
    valid: int
    valid_fraction: float | None
    status: dict[str, int]
    epipolar_offset_mean_px: float | None
    epipolar_offset_rms_px: float | None
    epipolar_offset_sd_px: float | None
    epipolar_residual_rms_px: float | None
    epipolar_check: EpipolarCheck | None
    plane_residual_rms_mm: float | None
    zncc_median: dict[str, float | None]
    sigma_median_mm: dict[str, float | None]
    sigma_calibration_median_mm: dict[str, float | None] | None
    budget_median_mm: dict[str, dict[str, float]]
    uncertainty_includes: str
    smoothing: Smoothing | None
    patch: PatchChoice | None
    camera_motion: MotionCheck | None = None
    systematic: Mapping[str, object] | None = None
    reference_step: int | None = None
    points_by_reference: dict[str, int] | None = None
    displacement_mm: dict[str, Span | None] | None = None
    failed_seeds_px: tuple[tuple[float, float], ...] = ()

    def document(self) -> dict[str, object]:
        """Return it as plain values; a shape has no entries of displacements."""
        of_motion = ("reference_step", "points_by_reference", "displacement_mm")
        motion = None if self.camera_motion is None else self.camera_motion.document()
        plain = {**asdict(replace(self, camera_motion=None)), "camera_motion": motion}
        left_out = set() if self.kind == "displacement" else set(of_motion)
        if not self.failed_seeds_px:
            left_out.add("failed_seeds_px")
        return {k: v for k, v in plain.items() if k not in left_out}


def summarise(
    result: Field,
    *,
    rbe_px: float | None = None,
    reference: int = 0,
    imported: bool = False,
    camera_motion: MotionCheck | None = None,
    systematic: Mapping[str, object] | None = None,
    rows_apart: str = "",
) -> StepSummary:
    """Summarise one field.

    Parameters
    ----------
    result
        The field.
    rbe_px
        The calibration's own reprojection error, if it is known.
    reference
        Number of the sequence's reference.
    imported
        True for another program's calibration, whose own error is not known.
    camera_motion
        The finding about the cameras when the step was measured.
    systematic
        The systematic terms, as :meth:`stereorig.core.systematic.terms.Systematic.document` gives them.
    rows_apart
        The finding about images whose rows are of two moments; empty for none.
    """
    check = check_epipolar(result, rbe_px, imported=imported)
    status = result.status
    valid = result.valid
    points = int((status != PointStatus.MASKED).sum())
    n = int(valid.sum())
    epipolar = result.epipolar_px[valid]
    names = ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")[: result.covariance.shape[-1]]
    sigma = result.sigma_mm[valid]
    zncc = result.zncc[valid]
    of_calibration = None
    if result.common is not None:
        causes = Causes.unseparated(result.common.shape[-1]) if result.causes is None else result.causes
        if "calibration" in causes.separate:
            of_calibration = causes.of_calibration(result.common)[valid]
    summary = StepSummary(
        kind="displacement" if result.has_motion else "shape",
        points=points,
        valid=n,
        valid_fraction=n / points if points else None,
        status={s.name.lower(): int((status == s).sum()) for s in PointStatus if (status == s).any()},
        epipolar_offset_mean_px=float(epipolar.mean()) if n else None,
        epipolar_offset_rms_px=_rms(epipolar),
        epipolar_offset_sd_px=float(epipolar.std()) if n else None,
        epipolar_residual_rms_px=_rms(epipolar / 2),
        epipolar_check=None if check is None else check.with_finding(rows_apart),
        plane_residual_rms_mm=_rms(plane_residuals_mm(result.xyz_mm[valid])) if n >= 4 else None,
        zncc_median={name: median(zncc[:, k]) if n else None for k, name in enumerate(COMPARISONS[: zncc.shape[-1]])},
        sigma_median_mm={name: median(sigma[:, k]) if n else None for k, name in enumerate(names)},
        sigma_calibration_median_mm=None
        if of_calibration is None
        else {name: median(of_calibration[:, k]) if n else None for k, name in enumerate(names)},
        budget_median_mm={name: one.median for name, one in field_budgets(result, spread_points(valid)).items()},
        uncertainty_includes=Included.of_field(result).text,
        smoothing=result.smoothing,
        patch=result.patch,
        camera_motion=camera_motion,
        systematic=systematic,
        failed_seeds_px=result.failed_seeds_px,
    )
    if result.uvw_mm is None:
        return summary
    matched = result.references
    steps, counts = np.unique(np.full(n, reference) if matched is None else matched.steps[valid], return_counts=True)
    uvw = result.uvw_mm[valid]
    return replace(
        summary,
        reference_step=reference if matched is None else matched.step,
        points_by_reference={str(k): int(c) for k, c in zip(steps, counts, strict=True)},
        displacement_mm={
            name: Span(float(a.mean()), float(a.min()), float(a.max())) if n else None
            for name, a in zip(("u", "v", "w"), uvw.T, strict=True)
        },
    )


@dataclass(frozen=True, kw_only=True)
class SequenceSummary:
    """``summary.json``: summaries of a measurement's steps, also of one that failed or was stopped.

    Attributes
    ----------
    state
        ``succeeded``, or another final state of the analysis' job.
    calibration
        ``sha256``; ``file`` and ``source`` if a file was named.
    settings
        As :class:`stereorig.core.settings.StoredSettings`.
    seconds
        Duration of the measurement.
    steps
        An entry a finished step, in their order.
    steps_failed
        The problem of each step that could not be measured, by its number.
    region_found
        The specimen's outline that was found because no region was given: `text`, `outlines_px` of its parts and
        `holes_px` in them, `share` of the image, `matches` on it; the mask is the region's.
    """

    state: str
    software_version: str
    created: str
    calibration: Mapping[str, object]
    settings: Mapping[str, object]
    seconds: float
    steps: Sequence[Mapping[str, object]]
    steps_failed: Mapping[str, object] = field(default_factory=dict)
    region_found: Mapping[str, object] | None = None
    format_version: int = FORMAT_VERSION

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        return asdict(self)


def region_found(specimen: Specimen) -> dict[str, object]:
    """Return a specimen that was found, as the summary states it."""
    return {
        "text": specimen.text,
        "share": round(specimen.share, 4),
        "matches": specimen.matches,
        "outlines_px": [part.tolist() for part in specimen.outlines_px],
        "holes_px": [hole.tolist() for hole in specimen.holes_px],
    }


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
