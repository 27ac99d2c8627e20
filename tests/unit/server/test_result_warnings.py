"""Warnings of an analysis, from the files that a measurement leaves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stereorig.server.results.warnings.analysis import analysis_warnings

FAILED = {"level": "failed", "offset_px": 0.115, "reason": "camera 2 sees the points 0.115 px off"}
FINE = {"level": "ok", "offset_px": 0.01, "reason": "camera 2 sees the points 0.010 px off"}


def step(n: int, **more: Any) -> dict[str, Any]:
    return {"n": n, "points": 900, "valid": 900, "valid_fraction": 1.0, "epipolar_check": FINE, "status": {}} | more


def put(path: Path, document: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An analysis in a test's folder, its steps measured without a finding."""
    test = tmp_path / "data" / "tests" / "t1"
    put(test / "test.json", {"id": "t1", "calibration_id": "c1"})
    put(test / "calibration.json", {"verdict": {"level": "good", "reasons": []}})
    for n in (0, 1):
        put(test / "steps" / f"{n:04d}" / "step.json", {"n": n, "quality": {"code": "ok"}})
        put(test / "analyses" / "a1" / f"step_{n:04d}.json", step(n))
        (test / "analyses" / "a1" / f"step_{n:04d}.nc").touch()
    return test / "analyses" / "a1"


def codes(folder: Path, **more: Any) -> list[tuple[str, str]]:
    return [(one.code, one.level) for one in analysis_warnings(folder, **more)]


def test_a_sound_measurement_has_no_warning(folder: Path) -> None:
    assert codes(folder) == []


def test_a_failed_epipolar_check_is_named_with_its_step_its_figure_and_a_remedy(folder: Path) -> None:
    put(folder / "step_0001.json", step(1, epipolar_check=FAILED))
    (found,) = analysis_warnings(folder)
    assert (found.code, found.level, found.steps) == ("epipolar_check_failed", "failed", (1,))
    assert "Step 1" in found.text
    assert "0.115 px" in found.text
    assert "calibrate again" in found.remedy


@pytest.mark.parametrize(("valid", "level"), [(371, "failed"), (630, "warning"), (810, None)])
def test_few_points_with_values_warn_or_fail_by_their_share(folder: Path, valid: int, level: str | None) -> None:
    low = step(1, valid=valid, valid_fraction=valid / 900, status={"ok": valid, "low_correlation": 900 - valid})
    put(folder / "step_0001.json", low)
    found = analysis_warnings(folder)
    assert [one.level for one in found] == ([] if level is None else [level])
    if found:
        assert f"{valid} of 900 ({100 * valid / 900:.0f} %)" in found[0].text
        assert "low correlation" in found[0].text
        assert "`" not in found[0].text + found[0].remedy  # read by people, on the page and in the terminal


def test_failed_checks_come_before_warnings(folder: Path) -> None:
    home = folder.parent.parent
    put(home / "steps" / "0001" / "step.json", {"n": 1, "quality": {"code": "saturated"}})
    put(
        home / "steps" / "0000" / "step.json", {"n": 0, "quality": {"code": "cameras_off_zero"}, "warnings": ["cam1 x"]}
    )
    problem = {"code": "image_blank", "detail": "The image is blank.", "remedy": "Look at it."}
    assert codes(folder, stale=["cam1 of step 1 was replaced"], failed={"2": problem}) == [
        ("cameras_off_zero", "failed"),
        ("steps_failed", "warning"),
        ("image_quality", "warning"),
        ("out_of_date", "warning"),
    ]


@pytest.mark.parametrize(
    ("decision", "expected"),
    [
        (None, [("calibration_failed", "failed")]),
        ("accepted", [("calibration_failed", "warning")]),
        ("discarded", [("calibration_discarded", "failed"), ("calibration_failed", "failed")]),
    ],
)
def test_a_calibration_that_failed_or_was_discarded_marks_what_was_measured_with_it(
    folder: Path, decision: str | None, expected: list[tuple[str, str]]
) -> None:
    home = folder.parent.parent
    put(home / "calibration.json", {"verdict": {"level": "failed", "reasons": ["RBE of 2 px."]}})
    put(home.parent.parent / "calibrations" / "c1" / "review.json", {"decision": decision, "note": "bumped"})
    assert codes(folder) == expected


def test_results_alone_are_judged_by_their_summary(tmp_path: Path) -> None:
    put(tmp_path / "out" / "summary.json", {"steps": [step(0), step(1, epipolar_check=FAILED)], "steps_failed": {}})
    assert codes(tmp_path / "out") == [("epipolar_check_failed", "failed")]
