"""Scale errors and drift, by generalised least squares over all steps and lengths with their common errors.

A step's error is y = d - t = S t + v tau + noise, with the scale errors S in the plane and in depth, the drift v and
the time tau since the reference. The errors' covariance is the sum of
:func:`stereorig.core.certify.measured.joint_covariance` and the covariance of the known ways, so that the calibration's
own stated uncertainty is in every estimate's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.certify.comparisons import direction_of
from stereorig.core.certify.evidence import CheckedLength, Evidence, MovedStep, StaticStep
from stereorig.core.certify.measured import joint_covariance

_NOTHING = 1e-12


@dataclass(frozen=True)
class Estimated:
    """A number with its standard uncertainty.

    Attributes
    ----------
    value, u
        Relative scale errors without unit, drifts in mm over the whole procedure.
    """

    value: float
    u: float

    @property
    def sigmas(self) -> float:
        """The value over its standard uncertainty; NaN without one."""
        return abs(self.value) / self.u if self.u > 0.0 else float("nan")

    def less(self, other: Estimated) -> Estimated:
        """Return the difference from one that is independent."""
        return Estimated(self.value - other.value, float(np.hypot(self.u, other.u)))


@dataclass(frozen=True)
class Scales:
    """Scale errors and drift; None if the procedure does not show them.

    Attributes
    ----------
    length
        From the known lengths: measured over known, less one.
    in_plane, in_depth
        From the known ways, along X and Y and along Z.
    drift_mm
        Along X, Y, Z, from the reference to the last step.
    duration_s
        Time from the reference to the last step.
    """

    length: Estimated | None = None
    in_plane: Estimated | None = None
    in_depth: Estimated | None = None
    drift_mm: tuple[Estimated, Estimated, Estimated] | None = None
    duration_s: float | None = None


def scales_of(evidence: Evidence) -> Scales:
    """Return the estimates from the errors of all steps together."""
    in_plane, in_depth, drift, duration = _of_ways([*evidence.static, *evidence.translations])
    return Scales(_of_lengths(evidence.lengths), in_plane, in_depth, drift, duration)


def _of_lengths(lengths: Sequence[CheckedLength]) -> Estimated | None:
    if not lengths:
        return None
    known = np.array([one.known_mm for one in lengths])
    error = np.array([one.measured.value[0] for one in lengths]) - known
    covariance = joint_covariance([one.measured for one in lengths])
    sigma = np.array([one.sigma_mm for one in lengths])
    for artefact in {one.artefact for one in lengths}:
        own = sigma * np.array([one.artefact == artefact for one in lengths])
        covariance += np.outer(own, own)
    return _solved(known[:, None], error, covariance)[0]


def _of_ways(
    steps: Sequence[StaticStep | MovedStep],
) -> tuple[Estimated | None, Estimated | None, tuple[Estimated, Estimated, Estimated] | None, float | None]:
    if not steps:
        return None, None, None, None
    rows, errors, ways = [], [], np.zeros((0, 0))
    take = np.zeros((0, 0))
    times = [step.time_s for step in steps]
    timed = all(time is not None for time in times)
    duration = max((abs(t) for t in times if t is not None), default=0.0) if timed else 0.0
    for step in steps:
        share = step.time_s / duration if duration > 0.0 and step.time_s is not None else 0.0
        A, row, error, covariance = _step(step, share)
        rows.append(row)
        errors.append(error)
        ways = _block_diagonal(ways, covariance)
        take = _block_diagonal(take, np.concatenate([np.zeros((len(A), 3)), A], axis=1))
    scale = [np.zeros(len(e)) for e in errors]
    for k, step in enumerate(steps):
        if isinstance(step, MovedStep):
            scale[k] = step.sigma_scale * (rows[k][:, 0] + rows[k][:, 1])
    stage = np.concatenate(scale)
    covariance = take @ joint_covariance([step.motion for step in steps]) @ take.T + ways + np.outer(stage, stage)
    found = _solved(np.concatenate(rows), np.concatenate(errors), covariance)
    x, y, z = found[2:]
    drift = None if x is None or y is None or z is None else (x, y, z)
    return found[0], found[1], drift, duration if drift is not None else None


def _step(step: StaticStep | MovedStep, share: float) -> tuple[Float, Float, Float, Float]:
    """Return the rows (m, 3) that take the step's translation, its design (m, 5), its errors, and the way's own noise.

    The columns are the scale in the plane and in depth, and the drift along X, Y, Z over the whole procedure.
    """
    measured = step.motion.value[3:]
    drift = share * np.eye(3)
    if isinstance(step, StaticStep):
        return np.eye(3), np.hstack([np.zeros((3, 2)), drift]), measured, np.zeros((3, 3))
    if step.translation_mm is not None:
        t = step.translation_mm
        by_scale = np.array([[t[0], 0.0], [t[1], 0.0], [0.0, t[2]]])
        noise = step.sigma_mm**2 * np.eye(3)
        return np.eye(3), np.hstack([by_scale, drift]), measured - t, noise
    assert step.distance_mm is not None
    along = direction_of(step)[None]
    plane, depth = float((along[0, :2] ** 2).sum()), float(along[0, 2] ** 2)
    row = np.hstack([step.distance_mm * np.array([[plane, depth]]), along @ drift])
    error = np.array([float(np.linalg.norm(measured)) - step.distance_mm])
    return along, row, error, np.array([[step.sigma_mm**2]])


def _block_diagonal(one: Float, other: Float) -> Float:
    """Return the block diagonal of two matrices."""
    out = np.zeros((one.shape[0] + other.shape[0], one.shape[1] + other.shape[1]))
    out[: one.shape[0], : one.shape[1]] = one
    out[one.shape[0] :, one.shape[1] :] = other
    return out


def _solved(design: Float, error: Float, covariance: Float) -> list[Estimated | None]:
    """Return the unknowns' estimates; None of those that no row holds."""
    held = np.flatnonzero(np.abs(design).max(axis=0) > _NOTHING)
    found: list[Estimated | None] = [None] * design.shape[1]
    if not held.size or not np.isfinite(covariance).all():
        return found
    A = design[:, held]
    # without any noise nothing could be weighed: a picometre is none
    weight = np.linalg.pinv(covariance + 1e-18 * np.eye(len(error)), hermitian=True, rcond=1e-14)
    inverse = np.linalg.pinv(A.T @ weight @ A, hermitian=True)
    value = inverse @ (A.T @ weight @ error)
    for k, column in enumerate(held):
        found[column] = Estimated(float(value[k]), float(np.sqrt(inverse[k, k])))
    return found
