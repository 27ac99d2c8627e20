"""The verdict of a verification: every comparison judged, missing evidence, and probable causes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from stereorig.core.certify.comparison import (
    CertificateLimits,
    Group,
    Judged,
    Outcome,
    coverage_factor,
    judged,
    worst_of,
)
from stereorig.core.certify.comparisons import comparisons_of
from stereorig.core.certify.evidence import Evidence
from stereorig.core.certify.extensometer_class import ExtensometerClass, extensometer_class, is_coarser
from stereorig.core.certify.noise_floor import FloorRow, noise_floor
from stereorig.core.certify.scales import Scales, scales_of
from stereorig.core.certify.suspects import Suspect, suspects_of

ReasonCode = Literal[
    "error_beyond_limit",
    "error_beyond_uncertainty",
    "noise_beyond_uncertainty",
    "common_error",
    "camera_moved",
    "extensometer_class",
    "extensometer_reference",
    "too_few",
    "calibration_not_included",
    "nothing_compared",
]
_GROUPS: tuple[tuple[Group, str], ...] = (
    ("static", "rest in static pairs"),
    ("displacement", "displacements"),
    ("strain", "strain of a body that only moves"),
    ("rotation", "angles"),
    ("length", "lengths"),
)
_UNITS = {"mm": (1e3, "um"), "rad": (1e3, "mrad"), "1": (1e6, "microstrain")}


@dataclass(frozen=True)
class Reason:
    """A reason for a verdict other than ``pass``.

    Attributes
    ----------
    outcome
        The lowest verdict that this reason allows: ``conditional`` or ``fail``.
    code
        Stable name.
    text, remedy
        The reason with its figures, and the remedy.
    """

    outcome: Outcome
    code: ReasonCode
    text: str
    remedy: str


@dataclass(frozen=True)
class CertificateVerdict:
    """Outcome of a verification.

    Attributes
    ----------
    outcome
        ``pass``, ``conditional`` (usable within the limits that the reasons state) or ``fail``.
    k
        Coverage factor of the comparisons.
    reasons, suspects
        Reasons for a verdict other than ``pass``, and probable causes.
    floor, judged, scales, extensometer
        The tables.
    """

    outcome: Outcome
    k: float
    reasons: tuple[Reason, ...]
    suspects: tuple[Suspect, ...]
    floor: tuple[FloorRow, ...]
    judged: tuple[Judged, ...]
    scales: Scales
    extensometer: ExtensometerClass | None

    def of_group(self, group: Group) -> tuple[Judged, ...]:
        """Return the comparisons of one group."""
        return tuple(one for one in self.judged if one.comparison.group == group)

    def largest(self, group: Group) -> Judged | None:
        """Return the comparison with the largest error of a group; None without any."""
        return max(self.of_group(group), key=lambda one: abs(one.comparison.error), default=None)


def certify(evidence: Evidence, limits: CertificateLimits) -> CertificateVerdict:
    """Judge a verification procedure.

    The probability of a false fail is shared by thirds between the comparisons, each by itself, the scale errors and
    drifts, which all comparisons together give, and the ratios of the noise floor.
    """
    share = limits.false_alarm / 3.0
    comparisons = comparisons_of(evidence, limits)
    k = coverage_factor(len(comparisons), share)
    found = tuple(judged(one, k) for one in comparisons)
    floor = noise_floor(evidence.static, ratio_limit=limits.noise_ratio, false_alarm=share)
    scales = scales_of(evidence)
    suspects = suspects_of(evidence, scales, floor, false_alarm=share)
    extensometer = None if evidence.extensometer is None else extensometer_class(evidence.extensometer)
    reasons = (
        *_of_comparisons(found, k),
        *_of_floor(floor, limits),
        *_of_suspects(suspects, limits),
        *_of_extensometer(extensometer, limits),
        *_lacking(evidence, limits),
    )
    outcome = worst_of([reason.outcome for reason in reasons])
    return CertificateVerdict(outcome, k, reasons, suspects, floor, found, scales, extensometer)


def text_of(value: float, unit: str) -> str:
    """Return an error or an uncertainty in the unit in which it reads well."""
    factor, name = _UNITS[unit]
    return f"{factor * value:.3g} {name}"


def _of_comparisons(found: Sequence[Judged], k: float) -> Iterator[Reason]:
    for group, name in _GROUPS:
        for outcome in ("fail", "conditional"):
            off = [one for one in found if one.comparison.group == group and one.outcome == outcome]
            if off:
                yield _beyond(off, sum(one.comparison.group == group for one in found), name, k)


def _beyond(off: Sequence[Judged], count: int, name: str, k: float) -> Reason:
    worst = max(off, key=lambda one: abs(one.comparison.error) / (one.comparison.limit or one.expanded or 1e-300))
    one = worst.comparison
    where = one.name if one.n is None else f"{one.name}, step {one.n}"
    figures = f"{where}, off by {text_of(one.error, one.unit)}, U {text_of(worst.expanded, one.unit)} (k = {k:.2f})"
    if worst.outcome == "fail" and one.limit is not None:
        return Reason(
            "fail",
            "error_beyond_limit",
            f"{len(off)} of {count} {name} exceed the permissible error of {text_of(one.limit, one.unit)}; the worst: "
            f"{figures}.",
            "Follow what is suspect; do not use the system for that quantity until it passes.",
        )
    within = "" if one.limit is None else f", within the permissible {text_of(one.limit, one.unit)}"
    return Reason(
        worst.outcome,
        "error_beyond_uncertainty",
        f"{len(off)} of {count} {name} exceed their expanded uncertainty{within}; the worst: {figures}.",
        "Follow what is suspect; until then the stated uncertainty is too small for that quantity.",
    )


def _of_floor(floor: Sequence[FloorRow], limits: CertificateLimits) -> Iterator[Reason]:
    off = [row for row in floor if row.outcome != "pass"]
    if off:
        worst = max(off, key=lambda row: row.ratio)
        yield Reason(
            worst_of([row.outcome for row in off]),
            "noise_beyond_uncertainty",
            f"The noise of {', '.join(row.name for row in off)} exceeds the stated one, at most {worst.ratio:.2f} "
            f"times ({limits.noise_ratio:g} is permissible).",
            "Multiply the stated uncertainties by that ratio, or find the noise's cause and take the procedure again.",
        )


def _of_suspects(suspects: Sequence[Suspect], limits: CertificateLimits) -> Iterator[Reason]:
    for suspect in suspects:
        if suspect.code == "camera_moved":
            yield Reason("fail", "camera_moved", suspect.text, suspect.remedy)
        elif suspect.code != "noise":
            by_length = suspect.code in ("calibration_scale", "known_length")
            limit = limits.length_mpe_um if by_length else limits.displacement_mpe_um
            # a limit defines the errors that matter, and each is compared with it
            outcome: Outcome = "fail" if limit is None else "conditional"
            yield Reason(outcome, "common_error", suspect.text, suspect.remedy)


def _of_extensometer(found: ExtensometerClass | None, limits: CertificateLimits) -> Iterator[Reason]:
    wanted = limits.extensometer_class
    if found is None:
        if wanted is not None:
            yield Reason(
                "conditional",
                "too_few",
                f"Class {wanted} of the virtual extensometer was asked for, and no reference readings were given.",
                "Give the reference extensometer's readings.",
            )
        return
    if wanted is not None and is_coarser(found.reached, wanted):
        got = "no class" if found.reached is None else f"class {found.reached}"
        yield Reason(
            "fail",
            "extensometer_class",
            f"The virtual extensometer reaches {got}; class {wanted} was asked for.",
            "Use a longer gauge, larger subsets or a larger scale, or ask for the class that is reached.",
        )
    elif wanted is not None and found.notes:
        yield Reason(
            "conditional",
            "extensometer_reference",
            f"The class rests on too little: {'; '.join(found.notes)}.",
            "Take ten readings or more over the range, two or more static steps, and state the gauge length and the "
            "reference's uncertainty.",
        )
    if not found.within_uncertainty:
        yield Reason(
            "conditional",
            "error_beyond_uncertainty",
            "The virtual extensometer differs from the reference by more than twice the standard uncertainty of both.",
            "Check that both read the same part of the specimen, and the reference's stated uncertainty.",
        )


def _lacking(evidence: Evidence, limits: CertificateLimits) -> Iterator[Reason]:
    parts = (
        ("static pairs", len(evidence.static), limits.static_steps),
        ("known translations", len(evidence.translations), limits.translations),
        ("known lengths", len(evidence.lengths), limits.lengths),
        ("rotations", len(evidence.rotations), limits.rotations),
    )
    if not any(count for _, count, _ in parts):
        yield Reason(
            "fail",
            "nothing_compared",
            "Nothing was compared with anything known.",
            "State which steps are static, and which ways, lengths and angles are known.",
        )
        return
    lacking = [f"{count} of {needed} {name}" for name, count, needed in parts if count < needed]
    if lacking:
        yield Reason(
            "conditional",
            "too_few",
            f"The procedure is not whole: there are {', '.join(lacking)}.",
            "Take what is lacking, or ask for less by the limits; the certificate then says so.",
        )
    if not evidence.calibration_known:
        yield Reason(
            "conditional",
            "calibration_not_included",
            "The stated uncertainties do not include the calibration's, which is not known.",
            "Calibrate with this program, or import a calibration with its covariance.",
        )
