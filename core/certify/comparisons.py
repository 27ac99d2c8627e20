"""The comparisons of a procedure: static pairs with rest, moves with known ways, lengths with known lengths."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.certify.comparison import CertificateLimits, Comparison
from stereorig.core.certify.evidence import CheckedLength, Evidence, MovedStep, StaticStep
from stereorig.core.certify.measured import Measured

_AXES = ("X", "Y", "Z")
_STRAINS = ("exx", "eyy", "exy")


def comparisons_of(evidence: Evidence, limits: CertificateLimits) -> tuple[Comparison, ...]:
    """Return every comparison, static pairs first."""
    found: list[Comparison] = []
    for step in evidence.static:
        found += _static(step, limits)
    for moved in evidence.moved:
        found += _moved(moved, limits)
    return (*found, *(_length(one, limits) for one in evidence.lengths))


def way_covariance(step: MovedStep) -> Float:
    """(3, 3) covariance of a known way: new at the step, and of the stage's scale."""
    assert step.translation_mm is not None
    scale = step.sigma_scale * step.translation_mm
    return np.asarray(step.sigma_mm**2 * np.eye(3) + np.outer(scale, scale))


def direction_of(step: MovedStep) -> Float:
    """(3,) unit vector along the measured translation; X for a zero translation."""
    way = step.motion.value[3:]
    size = float(np.linalg.norm(way))
    return np.asarray(way / size if size > 0.0 else np.array([1.0, 0.0, 0.0]))


def _static(step: StaticStep, limits: CertificateLimits) -> Iterator[Comparison]:
    limit = None if limits.displacement_mpe_um is None else 1e-3 * limits.displacement_mpe_um
    for k, axis in enumerate(_AXES):
        way, u = float(step.motion.value[3 + k]), float(step.motion.sigma[3 + k])
        yield Comparison("static", f"{axis} of a static pair", step.n, way, 0.0, u, "mm", limit)
    if step.strain is not None:
        yield from _strains(step.strain, "a static pair", step.n, limits)


def _moved(step: MovedStep, limits: CertificateLimits) -> Iterator[Comparison]:
    limit = None if limits.displacement_mpe_um is None else 1e-3 * limits.displacement_mpe_um
    motion = step.motion
    if step.translation_mm is not None:
        u = np.sqrt(motion.sigma[3:] ** 2 + np.diagonal(way_covariance(step)))
        for k, axis in enumerate(_AXES):
            known, way = float(step.translation_mm[k]), float(motion.value[3 + k])
            yield Comparison("displacement", f"{axis} of a translation", step.n, way, known, float(u[k]), "mm", limit)
    elif step.distance_mm is not None:
        along = direction_of(step)
        own = float(along @ motion.covariance[3:, 3:] @ along)
        known = step.distance_mm
        u_all = float(np.sqrt(own + step.sigma_mm**2 + (step.sigma_scale * known) ** 2))
        way = float(np.linalg.norm(motion.value[3:]))
        yield Comparison("displacement", "way of a translation", step.n, way, known, u_all, "mm", limit)
    if step.rotation and step.angle_rad is not None:
        yield _angle(step, limits)
    if step.strain is not None:
        yield from _strains(step.strain, "a rotation" if step.rotation else "a translation", step.n, limits)


def _angle(step: MovedStep, limits: CertificateLimits) -> Comparison:
    assert step.angle_rad is not None
    turn = step.motion.value[:3]
    angle = float(np.linalg.norm(turn))
    about = turn / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    own = float(about @ step.motion.covariance[:3, :3] @ about)
    limit = None if limits.rotation_mpe_mrad is None else 1e-3 * limits.rotation_mpe_mrad
    u = float(np.sqrt(own + step.sigma_rad**2))
    return Comparison("rotation", "angle of a rotation", step.n, angle, step.angle_rad, u, "rad", limit)


def _strains(strain: Measured, of: str, n: int, limits: CertificateLimits) -> Iterator[Comparison]:
    limit = None if limits.strain_mpe_microstrain is None else 1e-6 * limits.strain_mpe_microstrain
    for k, name in enumerate(_STRAINS):
        value, u = float(strain.value[k]), float(strain.sigma[k])
        yield Comparison("strain", f"{name} of {of}", n, value, 0.0, u, "1", limit)


def _length(one: CheckedLength, limits: CertificateLimits) -> Comparison:
    u = float(np.hypot(one.measured.sigma[0], one.sigma_mm))
    limit = limits.length_mpe_mm(one.known_mm)
    return Comparison("length", one.name, None, float(one.measured.value[0]), one.known_mm, u, "mm", limit)
