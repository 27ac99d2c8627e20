"""The verdict over drawn procedures: a whole system passes, a hidden fault fails it and is named."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.certify.certify import certify
from stereorig.core.certify.comparison import CertificateLimits
from stereorig.core.certify.evidence import Evidence
from stereorig.core.certify.scales import scales_of
from tests.support.certificate_evidence import PITCH_U, Fault, evidence

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
