"""Two calibrations of one rig with default priors: what both declare alike is one error, and cancels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, calibrate
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.native import calibration_content
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.results.calibration_checks import compare_loaded
from tests.support.calibration_truth import NOMINAL, Grid, make_views

OPTIONS = CalibrationOptions(lens="paper")
PAIRS = 5


def made(folder: Path, seed: int, **changed: Any) -> LoadedCalibration:
    views = make_views((0.0, 1.0, 2.0, 3.0, 4.0, 5.0), seed=seed)
    target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03, pitch_scale_sigma=1e-4)
    content = calibration_content(calibrate(views, Grid(pitch_scale_sigma=1e-4), NOMINAL, OPTIONS), target)
    content["target"] |= changed
    path = folder / f"{seed}.json"
    path.write_text(json.dumps(content))
    return load_calibration(path)


def test_what_both_calibrations_declare_alike_is_in_no_prediction_of_their_difference(tmp_path: Path) -> None:
    pairs = [(made(tmp_path, 2 * k), made(tmp_path, 2 * k + 1)) for k in range(PAIRS)]
    found = [compare_loaded(*pair) for pair in pairs]
    assert {c.shared for c in found} == {("stage", "target", "aspect")}
    assert "with the same stage and target and aspect in both" in found[0].text
    for name in ("shape_rms_mm", "epipolar_rms_px"):
        # a few parameters carry each: their mean square has a relative standard deviation of sqrt(2 / n) at most
        ratios = np.array([getattr(c, name).ratio for c in found])
        assert np.mean(ratios**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / PAIRS) / 2.0), (name, ratios)
    reduced = [c.chi_square / c.degrees for c in found if c.chi_square is not None and c.degrees]
    assert np.mean(reduced) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 14.0 / PAIRS)), reduced
    apart = compare_loaded(*pairs[0], independent=True)
    assert apart.shared == ()
    assert "the same" not in apart.text
    # independent, the pitch alone scales by 1.4e-4
    assert apart.scale.sigma is not None
    assert found[0].scale.sigma is not None
    assert apart.scale.sigma > 1.4e-4
    assert found[0].scale.sigma < 0.3 * apart.scale.sigma


def test_another_target_is_no_shared_one(tmp_path: Path) -> None:
    found = compare_loaded(made(tmp_path, 1), made(tmp_path, 2, line_width_mm=0.04))
    assert found.shared == ("stage", "aspect")
