"""Result files of format 1, kept from before in both their dialects, read as today's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from server.formats.results.reading import read_field, read_head, read_measured
from server.formats.results.settings import current_summary, stored_settings
from server.results.provenance import calibration_of
from server.results.steps import read_step
from tests.support.requirements import ROOT

OLD = ROOT / "tests" / "support" / "old_results"


@pytest.fixture(params=["command_line", "service"])
def folder(request: pytest.FixtureRequest) -> Path:
    return OLD / str(request.param)


def test_settings_are_told_by_todays_names(folder: Path) -> None:
    settings = read_head(folder / "step_0001.nc").settings
    assert "roi" not in settings
    assert settings["region"]["rectangle"] == [110.0, 105.0, 150.0, 145.0]
    stored = stored_settings(settings)
    assert (stored.subset_px, stored.spacing_px, stored.reference_update, stored.strain) == (21, 20, "auto", None)
    assert stored.region.cracks == [[(100.0, 60.0), (110.0, 60.0)]]
    assert stored.region.mask is None


def test_inputs_are_told_by_todays_names(folder: Path) -> None:
    inputs = read_head(folder / "step_0001.nc").inputs_sha256
    assert inputs.keys() == {"calibration", "reference_cam1", "reference_cam2", "cam1", "cam2"}
    assert calibration_of(read_step(folder / "step_0001.nc")) == inputs["calibration"]


def test_both_tell_the_same_field() -> None:
    one, two = (read_field(OLD / name / "step_0001.nc") for name in ("command_line", "service"))
    assert one.valid.all()
    np.testing.assert_allclose(one.uvw_mm, two.uvw_mm, atol=1e-4)  # one chose its patch, to the other it was told
    np.testing.assert_array_equal(read_measured(OLD / "service" / "step_0001.nc").covariance, two.covariance)


def test_steps_of_a_summary_have_their_number(folder: Path) -> None:
    steps: list[dict[str, Any]] = current_summary(json.loads((folder / "summary.json").read_text()))["steps"]
    assert [step["n"] for step in steps] == [0, 1]
    assert all(step["wall_s"] > 0.0 for step in steps)
