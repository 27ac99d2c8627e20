"""The class of a virtual extensometer, by the limits of ISO 9513.

A class is reached if every reading's error, the resolution and the gauge length are within its limits. The larger of
the relative and the absolute limit counts. The reference's expanded uncertainty (k = 2) is to be a third of the
permitted error at most.

The limits are those commonly quoted of ISO 9513:2012. Errors follow one rule, published for class 0.5: c percent, and
3 c micrometres below 300 um (http://laserextensometer.net/en/products/lex/calib05.html); gauge length and resolution
have no source that can be read freely, and were not compared with the standard's text.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.certify.comparison import ClassName
from stereorig.core.certify.evidence import ExtensometerPoint, ExtensometerRun

READINGS = 10
"""Readings of a series at least."""
_REFERENCE_SHARE = 1.0 / 3.0


@dataclass(frozen=True)
class ClassLimits:
    """Limits of a class: shares without unit, lengths in mm.

    Attributes
    ----------
    name
        The class.
    gauge_length
        Relative error of the gauge length.
    resolution, resolution_mm
        Relative to the reading, and absolute.
    error, error_mm
        Relative to the reading, and absolute.
    """

    name: ClassName
    gauge_length: float
    resolution: float
    resolution_mm: float
    error: float
    error_mm: float

    def permitted_mm(self, true_mm: float) -> float:
        """Return the permitted error of a reading."""
        return max(self.error * abs(true_mm), self.error_mm)

    def permitted_resolution_mm(self, true_mm: float) -> float:
        """Return the permitted resolution of a reading."""
        return max(self.resolution * abs(true_mm), self.resolution_mm)


CLASSES = (
    ClassLimits("0.2", 2e-3, 1e-3, 2e-4, 2e-3, 6e-4),
    ClassLimits("0.5", 5e-3, 2.5e-3, 5e-4, 5e-3, 1.5e-3),
    ClassLimits("1", 1e-2, 5e-3, 1e-3, 1e-2, 3e-3),
    ClassLimits("2", 2e-2, 1e-2, 2e-3, 2e-2, 6e-3),
)


@dataclass(frozen=True)
class ExtensometerRow:
    """One reading compared with the reference's.

    Attributes
    ----------
    n
        The step.
    true_mm, indicated_mm, error_mm
        Elongations, and the indicated less the true one.
    relative
        Error over the true elongation; None for zero elongation.
    u_mm
        Standard uncertainty of the error, of both.
    best
        Finest class whose limit the error keeps; None: none does.
    """

    n: int
    true_mm: float
    indicated_mm: float
    error_mm: float
    relative: float | None
    u_mm: float
    best: ClassName | None


@dataclass(frozen=True)
class ExtensometerClass:
    """A virtual extensometer's class.

    Attributes
    ----------
    reached
        Finest class whose conditions are all met; None: none.
    rows
        The readings.
    resolution_mm
        Half the range of the elongations read while nothing moved; None with fewer than two.
    gauge_length_error
        Relative; None if the gauge length was not stated.
    reference_fit
        Finest class that the reference is good enough for; None: none.
    within_uncertainty
        True if every error is within its expanded uncertainty, k = 2.
    notes
        Evidence that is too thin for the class.
    """

    reached: ClassName | None
    rows: tuple[ExtensometerRow, ...]
    resolution_mm: float | None
    gauge_length_error: float | None
    reference_fit: ClassName | None
    within_uncertainty: bool
    notes: tuple[str, ...]


def extensometer_class(run: ExtensometerRun) -> ExtensometerClass:
    """Return the class of a series of readings."""
    resolution = 0.5 * float(np.ptp(run.static_mm)) if len(run.static_mm) > 1 else None
    length = None
    if run.gauge_length_mm is not None and run.known_gauge_length_mm is not None:
        length = run.gauge_length_mm / run.known_gauge_length_mm - 1.0
    rows = tuple(_row(point) for point in run.points)
    reached = next((c.name for c in CLASSES if _holds(c, run, resolution, length)), None)
    fit = next((c.name for c in CLASSES if all(_fits(c, point) for point in run.points)), None)
    notes = []
    if len(rows) < READINGS:
        notes.append(f"{len(rows)} readings; {READINGS} are needed")
    if resolution is None:
        notes.append("no resolution: fewer than two static readings")
    if length is None:
        notes.append("the gauge length was not stated")
    if reached is not None and is_coarser(fit, reached):
        notes.append(f"the reference's uncertainty exceeds a third of the error that class {reached} permits")
    within = all(abs(row.error_mm) <= 2.0 * row.u_mm for row in rows)
    return ExtensometerClass(reached, rows, resolution, length, fit, within, tuple(notes))


def is_coarser(one: ClassName | None, other: ClassName) -> bool:
    """Return True if a class, or none, permits more than another."""
    return one is None or float(one) > float(other)


def _row(point: ExtensometerPoint) -> ExtensometerRow:
    error = point.indicated_mm - point.true_mm
    return ExtensometerRow(
        n=point.n,
        true_mm=point.true_mm,
        indicated_mm=point.indicated_mm,
        error_mm=error,
        relative=error / point.true_mm if point.true_mm != 0.0 else None,
        u_mm=float(np.hypot(point.sigma_mm, point.sigma_true_mm)),
        best=next((c.name for c in CLASSES if abs(error) <= c.permitted_mm(point.true_mm)), None),
    )


def _holds(limits: ClassLimits, run: ExtensometerRun, resolution: float | None, length: float | None) -> bool:
    if length is not None and not abs(length) <= limits.gauge_length:
        return False
    if not run.points:
        return False
    least = min(abs(point.true_mm) for point in run.points)
    if resolution is not None and not resolution <= limits.permitted_resolution_mm(least):
        return False
    return all(abs(p.indicated_mm - p.true_mm) <= limits.permitted_mm(p.true_mm) for p in run.points)


def _fits(limits: ClassLimits, point: ExtensometerPoint) -> bool:
    return 2.0 * point.sigma_true_mm <= _REFERENCE_SHARE * limits.permitted_mm(point.true_mm)
