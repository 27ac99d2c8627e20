"""Probable causes of an error common to many comparisons: the calibration's scale, the stage, a camera, warmth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from stereorig.core.certify.comparison import coverage_factor
from stereorig.core.certify.evidence import CameraOffset, Evidence
from stereorig.core.certify.noise_floor import FloorRow
from stereorig.core.certify.scales import Estimated, Scales

SuspectCode = Literal["camera_moved", "calibration_scale", "known_length", "stage_scale", "drift", "noise"]
_ESTIMATES = 6  # three scales and three drifts are looked at


@dataclass(frozen=True)
class Suspect:
    """A probable cause.

    Attributes
    ----------
    code
        Stable name.
    text
        The cause, with the figures.
    remedy
        The check that shows it, and the remedy.
    """

    code: SuspectCode
    text: str
    remedy: str


def suspects_of(
    evidence: Evidence, scales: Scales, floor: Sequence[FloorRow], *, false_alarm: float
) -> tuple[Suspect, ...]:
    """Return the probable causes, the most probable one first.

    A camera that moved explains wrong scales and apparent motions, so that these are then not listed.
    """
    k = coverage_factor(_ESTIMATES, false_alarm)
    noisy = [row for row in floor if row.outcome != "pass"]
    noise = (_noise(noisy),) if noisy else ()
    moved = [one for one in evidence.cameras if one.moved]
    if moved:
        return (_camera(moved), *noise)
    return (*_scale_suspects(scales, k), *_drift(scales, k), *noise)


def sure(estimate: Estimated | None, k: float) -> bool:
    """Return True for an estimate farther from zero than k standard uncertainties."""
    return estimate is not None and estimate.sigmas > k


def percent(estimate: Estimated, k: float) -> str:
    """Return a relative error with its expanded uncertainty as text."""
    return f"{100.0 * estimate.value:+.3f} % (U {100.0 * k * estimate.u:.3f} %, k = {k:.2g})"


def _scale_suspects(scales: Scales, k: float) -> tuple[Suspect, ...]:
    length = scales.length
    ways = [one for one in (scales.in_plane, scales.in_depth) if one is not None]
    wrong = [one for one in ways if sure(one, k)]
    if length is not None and sure(length, k):
        # the nearer one of both explanations: known ways have the same scale error as lengths, or none
        best = min(ways, key=lambda one: one.u, default=None)
        follows = best is not None and abs(best.value - length.value) < abs(best.value)
        if best is not None and not follows and not wrong:
            return (_known_length(length, k),)
        stage = (_stage(scales, k),) if wrong and not follows else ()
        return (_calibration(length, k, beside=follows, alone=best is None), *stage)
    if not wrong:
        return ()
    worst = max(wrong, key=lambda one: one.sigmas)
    if length is None and len(wrong) == len(ways) > 1 and not sure(wrong[0].less(wrong[1]), k):
        return (_calibration(worst, k, beside=True, alone=True), _stage(scales, k))
    return (_stage(scales, k),)


def _calibration(scale: Estimated, k: float, *, beside: bool, alone: bool) -> Suspect:
    ways = "; displacements are off by the same share" if beside else ""
    other = ", or the stated length of the artefact" if alone else ""
    return Suspect(
        "calibration_scale",
        f"The scale of the calibration{other}: measured lengths are off by {percent(scale, k)}{ways}. So they are "
        "where the target's pitch is not as stated.",
        f"Have the target's pitch measured (it would be {1.0 / (1.0 + scale.value):.5f} of the stated one), correct "
        "it, and calibrate again.",
    )


def _known_length(length: Estimated, k: float) -> Suspect:
    return Suspect(
        "known_length",
        f"The stated length of the artefact: it is measured {percent(length, k)} off, while known ways are measured "
        "right.",
        "Check the artefact's certificate and its temperature; measure another one.",
    )


def _stage(scales: Scales, k: float) -> Suspect:
    parts = [("in the plane", scales.in_plane), ("in depth", scales.in_depth)]
    text = ", ".join(f"{percent(one, k)} {where}" for where, one in parts if one is not None)
    right = "" if scales.length is None else ", while known lengths are measured right"
    return Suspect(
        "stage_scale",
        f"The scale of the stage's ways: displacements are off by {text}{right}.",
        "Check the stage's scale with a gauge block or another stage, and the stated ways; where the same stage gave "
        "the steps of the calibration, calibrate again after it is corrected.",
    )


def _drift(scales: Scales, k: float) -> tuple[Suspect, ...]:
    drift = scales.drift_mm
    if drift is None or scales.duration_s is None or not any(sure(one, k) for one in drift):
        return ()
    ways = ", ".join(f"{axis} {1e3 * one.value:+.2f}" for axis, one in zip("XYZ", drift, strict=True))
    along = max(zip("XYZ", drift, strict=True), key=lambda pair: pair[1].sigmas)
    per_hour = 3.6e6 * along[1].value / scales.duration_s
    return (
        Suspect(
            "drift",
            f"Something warms or creeps: beside the known ways the field moves steadily with time, by {ways} um in "
            f"{scales.duration_s:.0f} s (mostly {along[0]}, {per_hour:+.1f} um an hour). So it is where the stage, its "
            "mount or the cameras' beam is heated.",
            "Let stage and cameras warm up before the calibration, keep heat and draught away, and take the procedure "
            "again.",
        ),
    )


def _camera(moved: Sequence[CameraOffset]) -> Suspect:
    worst = max(moved, key=lambda one: one.sigmas)
    since = {"calibration": "the calibration", "reference": "the reference"}.get(worst.against, "the step before")
    return Suspect(
        "camera_moved",
        f"A camera moved since {since}: matched points lie {worst.offset_px:.3f} px off their epipolar lines in step "
        f"{worst.n} ({worst.expected_px:.3f} px are expected, {worst.sigmas:.1f} sigma); {len(moved)} findings say "
        "so. Lengths and displacements are then off as well.",
        "Fix cameras and lenses, repair the calibration (stereorig calibration repair) or calibrate again, and take "
        "the procedure again.",
    )


def _noise(rows: Sequence[FloorRow]) -> Suspect:
    worst = max(rows, key=lambda row: row.ratio)
    return Suspect(
        "noise",
        f"Noise that the stated uncertainty does not hold: the scatter of {worst.name} in static pairs is "
        f"{worst.ratio:.2f} times the stated one (from {worst.low:.2f} to {worst.high:.2f}).",
        "Look for flicker, vibration, air that moves or a pattern out of focus; measure the cameras' noise "
        "(stereorig noise).",
    )
