"""A camera that moved after the calibration shows in the field's epipolar offset."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.epipolar_offset import check_epipolar
from stereorig.core.field.points.result import Field
from stereorig.core.measure import MeasureOptions, measure_shape
from stereorig.server.cli import main
from stereorig.server.formats.images import write_image
from tests.support.field_bench import grid, pair, take


def bumped(by_px: float) -> StereoPair:
    """The pair as it was calibrated, if camera 2's image has moved up by so much since."""
    cam2 = pair().cam2
    assert isinstance(cam2.lens, SeidelLens)
    return StereoPair(pair().cam1, replace(cam2, lens=replace(cam2.lens, cy_px=cam2.lens.cy_px + by_px)))


def measured(by_px: float) -> Field:
    return measure_shape(bumped(by_px), *take("block"), grid(), MeasureOptions(subset_px=33))


@pytest.mark.fault(35)
def test_hundredths_of_a_pixel_are_told() -> None:
    for by_px, level in ((0.0, "ok"), (0.03, "ok"), (0.075, "warning"), (0.14, "failed"), (-0.14, "failed")):
        check = check_epipolar(measured(by_px), 0.004)
        assert check is not None
        # the offset's sign and the line's tilt aside, camera 2 moved across nearly horizontal lines
        assert abs(check.offset_px - abs(by_px)) < 0.004 + 0.03 * abs(by_px)
        assert check.level == level
        assert ("calibrate again" in check.reason) == (level != "ok")


@pytest.mark.fault(35)
def test_it_is_held_against_the_calibrations_own() -> None:
    field = measured(0.12)
    found = [check_epipolar(field, rbe) for rbe in (None, 0.004, 0.02, 0.04)]
    assert [check.level for check in found if check] == ["failed", "failed", "warning", "ok"]
    assert found[0] is not None
    assert "unknown" in found[0].reason


def test_noise_alone_is_no_offset() -> None:
    field = measured(0.0)
    rng = np.random.default_rng(3)
    quiet = [
        check_epipolar(
            replace(field, epipolar_px=np.where(field.valid, rng.normal(0, 0.05, field.shape), np.nan)), None
        )
        for _ in range(50)
    ]
    # sd 0.05 px over n points: a surface of six terms explains 0.05 sqrt(6 / n) of it by chance, which is taken out
    chance = 0.05 * np.sqrt(6.0 / field.valid.sum())
    assert np.sqrt(np.mean([check.offset_px**2 for check in quiet if check])) < 1.1 * chance
    empty = np.full(field.shape, np.nan)
    assert check_epipolar(replace(field, epipolar_px=empty), None) is None


@pytest.mark.fault(35)
def test_the_command_line_says_it_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for n, load in enumerate((0.0, 0.5, 1.0)):
        for name, image in zip(("cam1", "cam2"), take("block", load), strict=True):
            write_image(tmp_path / f"{name}_{n}.tif", image)
    wrong = bumped(0.2)
    content = {"cam1": wrong.cam1.paper_parameters(), "cam2": wrong.cam2.paper_parameters()}
    checks = {"checks": {"held_out": {"rbe_px": 0.005}}}
    (tmp_path / "calibration.json").write_text(json.dumps(content | checks))
    arguments = [
        "measure",
        "--cam1",
        str(tmp_path / "cam1_*.tif"),
        "--cam2",
        str(tmp_path / "cam2_*.tif"),
        "--subset",
        "33",
        "--calibration",
        str(tmp_path / "calibration.json"),
        "--roi",
        "40,40,220,180",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert (printed.out + printed.err).count("calibrate again") == 1
    steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
    assert [step["epipolar_check"]["level"] for step in steps] == ["failed"] * 3
    assert steps[0]["epipolar_check"]["own_px"] == pytest.approx(0.01)
