"""Result files of format 1, kept from before in both their dialects and with their names, read as today's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest

from core.settings import AnalysisSettings
from server.formats.results.reading import read_field, read_head, read_measured
from server.formats.results.settings import current_entries, current_summary, stored_settings
from server.formats.results.strain import read_strain
from server.report.records import TestRecord as ReportedTest
from server.results.gauges.request import GaugeRequest, ThreeTwoOneAlignment
from server.results.provenance import calibration_of
from server.results.steps import read_step
from server.store.documents import JobRecord, TestRecord
from tests.support.requirements import ROOT

OLD = ROOT / "tests" / "support" / "old_results"


@pytest.fixture(params=["command_line", "service"])
def folder(request: pytest.FixtureRequest) -> Path:
    return OLD / str(request.param)


def test_settings_have_todays_names(folder: Path) -> None:
    settings = read_head(folder / "step_0001.nc").settings
    assert "roi" not in settings
    assert settings["region"]["rectangle"] == [110.0, 105.0, 150.0, 145.0]
    stored = stored_settings(settings)
    assert (stored.subset_px, stored.spacing_px, stored.reference_update, stored.strain) == (21, 20, "auto", None)
    assert stored.region.cracks == [[(100.0, 60.0), (110.0, 60.0)]]
    assert stored.region.mask is None


def test_inputs_have_todays_names(folder: Path) -> None:
    inputs = read_head(folder / "step_0001.nc").inputs_sha256
    assert inputs.keys() == {"calibration", "reference_cam1", "reference_cam2", "cam1", "cam2"}
    assert calibration_of(read_step(folder / "step_0001.nc")) == inputs["calibration"]


def test_both_hold_the_same_field() -> None:
    one, two = (read_field(OLD / name / "step_0001.nc") for name in ("command_line", "service"))
    assert one.valid.all()
    np.testing.assert_allclose(one.uvw_mm, two.uvw_mm, atol=1e-4)  # one chose its patch, to the other it was given
    np.testing.assert_array_equal(read_measured(OLD / "service" / "step_0001.nc").covariance, two.covariance)


def test_steps_of_a_summary_have_their_number(folder: Path) -> None:
    steps: list[dict[str, Any]] = current_summary(json.loads((folder / "summary.json").read_text()))["steps"]
    assert [step["n"] for step in steps] == [0, 1]
    assert all(step["wall_s"] > 0.0 for step in steps)


def test_patches_and_comparisons_have_todays_names(folder: Path) -> None:
    choice = read_field(folder / "step_0001.nc").patch
    assert choice is not None
    assert choice.patch == "affine"
    asked = "affine" if folder.name == "service" else "auto"
    assert (choice.asked, stored_settings(read_head(folder / "step_0001.nc").settings).patch) == (asked, asked)
    step = current_summary(json.loads((folder / "summary.json").read_text()))["steps"][1]
    assert step["zncc_median"].keys() == {"cam1_ref__cam2_ref", "cam1_ref__cam1_cur", "cam1_ref__cam2_cur"}
    assert step["patch"]["patch"] == "affine"
    assert "quadratic_noise_mm" in step["patch"]


def test_a_propagated_covariance_is_read_by_its_earlier_name() -> None:
    path = OLD / "updated" / "step_0003.nc"
    references = read_field(path).references
    assert references is not None
    assert references.step == 2
    with netCDF4.Dataset(path) as stored:
        np.testing.assert_array_equal(references.noise_px2[..., 0, 1], stored["handed_on_noise_xy_px2"][...])
        np.testing.assert_array_equal(references.pattern_px2[..., 1, 1], stored["handed_on_pattern_yy_px2"][...])
    assert np.isfinite(references.noise_px2).all()


def test_earlier_names_of_parameters_are_accepted() -> None:
    old = {"region": {"rectangle": [0, 0, 60, 60]}, "step_px": 7, "patch": "curved"}
    settings = AnalysisSettings.model_validate(old)
    assert (settings.spacing_px, settings.patch) == (7, "quadratic")
    assert AnalysisSettings.model_validate({**old, "patch": "stretch"}).patch == "affine"
    assert "step_px" not in settings.model_dump()
    asked = {"align": {"kind": "3-2-1", "places_px": [[0, 0], [1, 0], [0, 1], [0, 0], [1, 0], [0, 0]]}}
    frame = GaugeRequest.model_validate(asked).align
    assert isinstance(frame, ThreeTwoOneAlignment)
    assert frame.positions_px[1] == (1.0, 0.0)


def test_documents_of_the_store_are_read_by_their_earlier_names() -> None:
    kept = json.loads((OLD / "store" / "test.json").read_text())
    assert TestRecord.model_validate(kept).metadata == {"operator": "A. Smith", "cam1": {"lens": {"f_number": 8.0}}}
    assert ReportedTest.model_validate(kept).metadata == kept["facts"]
    job = JobRecord.model_validate_json((OLD / "store" / "job.json").read_text())
    assert (job.progress.phase, job.progress.done) == ("step 4: done", 5000)
    assert "stage" not in job.plain()["progress"]  # type: ignore[operator]


def test_options_of_strain_are_read_by_their_earlier_names() -> None:
    kept = {"least_share": 0.3, "most_amplification": 9.0, "window": 9, "tensor": "hencky"}
    assert current_entries(kept) == {"min_share": 0.3, "max_amplification": 9.0, "window": 9, "tensor": "hencky"}
    strain = read_strain(OLD / "updated" / "step_0003.nc")
    assert strain is not None
    assert (strain.options.min_share, strain.options.max_amplification) == (0.5, 12.0)
