"""The evidence of a verification procedure in numbers: a rig with noise, a calibration's error and hidden faults."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.certify.evidence import CameraOffset, CheckedLength, Evidence, MovedStep, Scatter, StaticStep
from stereorig.core.certify.measured import Measured

SIGMA_MM = 2e-4
"""Noise of a mean displacement, new at each step and of the reference."""
SIGMA_RAD = 2e-5
SIGMA_STRAIN = 3e-6
PITCH_U = 1e-4
"""Relative standard uncertainty of the target's pitch: all lengths share the error."""
LENGTHS_MM = (10.0, 20.0, 30.0, 20.0, 40.0, 30.0)
#: forth and back, so that a scale error is no drift
WAYS_MM = ((1.0, 0, 0), (0, 0, 2.0), (0, 1.0, 0), (0, 0, -2.0), (-1.0, 0, 0), (0, 0, 1.0))
STEP_S = 30.0


@dataclass(frozen=True)
class Fault:
    """Hidden faults: errors of the target's pitch, the stage and the artefact, a drift, a camera that moved."""

    pitch: float = 0.0
    stage: float = 0.0
    artefact: float = 0.0
    drift_mm_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera: bool = False
    noise: float = 1.0


def evidence(seed: int, fault: Fault | None = None, *, static: int = 4, distances: bool = False) -> Evidence:
    """Draw a procedure: every error from the distribution that its uncertainty states."""
    fault = Fault() if fault is None else fault
    rng = np.random.default_rng(seed)
    # a target larger than stated makes all measured lengths too short
    scale = (1.0 + PITCH_U * rng.standard_normal()) / (1.0 + fault.pitch)
    reference = rng.standard_normal(6) * np.repeat([SIGMA_RAD, SIGMA_MM], 3)
    strain_reference = SIGMA_STRAIN * rng.standard_normal(3)
    drift = np.array(fault.drift_mm_per_s)

    def motion(true: Float, time_s: float) -> Measured:
        way = scale * (true + drift * time_s)
        new = rng.standard_normal(6) * np.repeat([SIGMA_RAD, SIGMA_MM], 3)
        value = np.concatenate([np.zeros(3), way]) + new + reference
        own = np.diag(np.repeat([SIGMA_RAD, SIGMA_MM], 3) ** 2)
        return Measured(value, own, own, np.concatenate([np.zeros(3), PITCH_U * way])[:, None])

    def strain() -> Measured:
        own = SIGMA_STRAIN**2 * np.eye(3)
        value = SIGMA_STRAIN * rng.standard_normal(3) + strain_reference
        return Measured(value, own, own, np.zeros((3, 1)))

    def scatter(name: str) -> Scatter:
        size, stated = 400, 1e-3 if name.endswith("_mm") else 5e-5
        values = fault.noise * stated * rng.standard_normal(size)
        return Scatter(float(values.mean()), float(values.std(ddof=1)), stated, size, float(size))

    names = ("u_mm", "v_mm", "w_mm", "exx", "eyy", "exy")
    at_rest = tuple(
        StaticStep(n, n * STEP_S, motion(np.zeros(3), n * STEP_S), {name: scatter(name) for name in names}, strain())
        for n in range(1, static + 1)
    )
    moved = []
    for k, stated in enumerate(np.array(WAYS_MM)):
        n = static + 1 + k
        true = (1.0 + fault.stage) * stated
        known = {"distance_mm": float(np.linalg.norm(stated))} if distances else {"translation_mm": stated}
        moved.append(MovedStep(n, n * STEP_S, motion(true, n * STEP_S), sigma_mm=1e-4, strain=strain(), **known))
    n = static + 1 + len(moved)
    turned = motion(np.zeros(3), n * STEP_S)
    turned.value[:3] += [0.0, 0.0, 0.05]
    moved.append(MovedStep(n, n * STEP_S, turned, rotation=True, angle_rad=0.05, sigma_rad=1e-5, strain=strain()))
    lengths = []
    for k, length in enumerate(LENGTHS_MM):
        own = np.array([[SIGMA_MM**2]])
        measured = scale * length * (1.0 + fault.artefact) + SIGMA_MM * rng.standard_normal()
        common = np.array([[PITCH_U * length]])
        one = Measured(np.array([measured]), own, np.zeros((1, 1)), common)
        lengths.append(CheckedLength(f"length {k}", one, length, 1e-4, "bar"))
    cameras = (CameraOffset(1, "calibration", fault.camera, 0.4 if fault.camera else 0.004, 0.01, 30.0),)
    return Evidence(at_rest, tuple(moved), tuple(lengths), None, cameras)
