"""The verdict over drawn procedures: a whole system passes, a hidden fault fails it and is named."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from stereorig.core.arrays import Float
from stereorig.core.certify.certify import certify
from stereorig.core.certify.comparison import CertificateLimits
from stereorig.core.certify.evidence import (
    CameraOffset,
    CheckedLength,
    Evidence,
    MovedStep,
    ScatterEvidence,
    StaticStep,
)
from stereorig.core.certify.measured import Measured
from stereorig.core.certify.scales import scales_of

# The evidence of a verification procedure in numbers: a rig with noise, a calibration's error and hidden faults.

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

    def scatter(name: str) -> ScatterEvidence:
        size, stated = 400, 1e-3 if name.endswith("_mm") else 5e-5
        values = fault.noise * stated * rng.standard_normal(size)
        return ScatterEvidence(float(values.mean()), float(values.std(ddof=1)), stated, size, float(size))

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


LIMITS = CertificateLimits.model_validate({})


def test_a_system_without_a_fault_passes_as_often_as_stated() -> None:
    # the false alarm is 1 %: more than 6 of 150 has a probability of 1e-3
    failed = sum(certify(evidence(seed), LIMITS).outcome != "pass" for seed in range(150))
    assert failed <= 6


@pytest.mark.parametrize("distances", [False, True])
@pytest.mark.parametrize(
    ("fault", "suspect"),
    [
        (Fault(pitch=1e-3), "calibration_scale"),
        (Fault(pitch=-1e-3), "calibration_scale"),
        (Fault(stage=1e-3), "stage_scale"),
        (Fault(artefact=1e-3), "known_length"),
        (Fault(drift_mm_per_s=(0.0, 0.0, 2e-5)), "drift"),
        (Fault(camera=True), "camera_moved"),
        (Fault(noise=2.0), "noise"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_hidden_fault_fails_and_is_the_first_suspect(fault: Fault, suspect: str, distances: bool) -> None:
    for seed in range(6):
        verdict = certify(evidence(seed, fault, distances=distances), LIMITS)
        assert verdict.outcome == "fail"
        assert verdict.suspects[0].code == suspect, (seed, verdict.suspects)


def test_without_known_lengths_ways_that_are_all_off_point_to_the_calibration_or_the_stage() -> None:
    found = evidence(1, Fault(pitch=1e-3))
    verdict = certify(Evidence(found.static, found.moved, (), None, found.cameras), LIMITS)
    assert [one.code for one in verdict.suspects] == ["calibration_scale", "stage_scale"]
    assert verdict.outcome == "fail"


def test_scale_errors_scatter_as_their_uncertainty_states() -> None:
    fault = Fault(pitch=1e-3, stage=3e-4, drift_mm_per_s=(1e-6, 0.0, -2e-6))
    found = [scales_of(evidence(seed, fault)) for seed in range(150)]
    duration = found[0].duration_s
    assert duration is not None
    true = {"length": 1.0 / 1.001 - 1.0, "in_plane": (1.0 + 3e-4) / 1.001 - 1.0, "in_depth": (1.0 + 3e-4) / 1.001 - 1.0}
    off = {name: [(getattr(s, name).value - t) / getattr(s, name).u for s in found] for name, t in true.items()}
    for k, drift in enumerate(fault.drift_mm_per_s):
        off["XYZ"[k]] = [(s.drift_mm[k].value - drift * duration) / s.drift_mm[k].u for s in found]  # type: ignore[index]
    for name, values in off.items():
        # the standard deviation of 150 normal numbers scatters by 6 %, their mean by 8 %
        assert 0.78 < np.std(values) < 1.22, name
        assert abs(np.mean(values)) < 0.32, name
    # the calibration's own share is in it: no number of lengths makes it smaller
    assert found[0].length is not None
    assert found[0].length.u > PITCH_U


def test_an_error_within_its_limit_is_a_condition_and_beyond_it_a_failure() -> None:
    found = evidence(3, Fault(pitch=1e-3))
    parts = {"displacement_mpe_um": 10.0}
    wide = CertificateLimits.model_validate({"length_mpe_um": 5.0, "length_mpe_um_per_m": 2000.0, **parts})
    narrow = CertificateLimits.model_validate({"length_mpe_um": 5.0, "length_mpe_um_per_m": 100.0, **parts})
    conditional, failed = certify(found, wide), certify(found, narrow)
    assert conditional.outcome == "conditional"
    assert failed.outcome == "fail"
    assert "error_beyond_limit" in {r.code for r in failed.reasons if r.outcome == "fail"}
    assert conditional.suspects[0].code == failed.suspects[0].code == "calibration_scale"


def test_what_is_lacking_is_a_condition_and_nothing_at_all_a_failure() -> None:
    whole = evidence(4)
    part = certify(Evidence(whole.static, whole.moved, whole.lengths[:2], None, whole.cameras), LIMITS)
    assert part.outcome == "conditional"
    assert [(r.code, "2 of 5 known lengths" in r.text) for r in part.reasons] == [("too_few", True)]
    assert certify(Evidence(), LIMITS).outcome == "fail"


def test_a_calibration_without_uncertainty_is_a_condition() -> None:
    whole = evidence(5)
    for step in (*whole.static, *whole.moved):
        object.__setattr__(step.motion, "common", None)
    for one in whole.lengths:
        object.__setattr__(one.measured, "common", None)
    lone = CertificateLimits.model_validate({"length_mpe_um": 50.0, "displacement_mpe_um": 50.0})
    verdict = certify(whole, lone)
    assert verdict.outcome == "conditional"
    assert "calibration_not_included" in {r.code for r in verdict.reasons}
