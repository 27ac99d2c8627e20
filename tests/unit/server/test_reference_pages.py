"""The generated pages of docs/reference say what the program does now."""

from __future__ import annotations

import pytest

from core.settings import AnalysisSettings
from core.status import PointStatus
from tests.bench.documents import reference, result_files, settings_pages

COMMAND = "run: make reference"


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return reference.pages()


def test_every_generated_page_is_up_to_date(pages: dict[str, str]) -> None:
    stale = [
        path
        for path, text in pages.items()
        if not (reference.FOLDER / path).exists() or (reference.FOLDER / path).read_text(encoding="utf-8") != text
    ]
    assert not stale, COMMAND


def test_no_page_is_left_of_a_tag_that_is_gone(pages: dict[str, str]) -> None:
    there = {f"api/{path.name}" for path in (reference.FOLDER / "api").glob("*.md")}
    assert there == {path for path in pages if path.startswith("api/")}, COMMAND


def test_every_status_has_a_remedy_and_every_key_a_meaning() -> None:
    assert set(result_files.REMEDIES) == set(PointStatus)
    assert set(result_files.CALIBRATION) == result_files.written_keys()


def test_the_options_named_for_settings_are_settings() -> None:
    without = {"start_from", "side_by_side"}  # of the service alone
    assert set(settings_pages.OPTIONS) == set(AnalysisSettings.model_fields) - without


def test_the_variables_that_scripts_rely_on_are_listed() -> None:
    listed = {name for name, *_ in result_files.variables()}
    promised = "x_px y_px x_mm y_mm z_mm u_mm v_mm w_mm normal_x status zncc epipolar_px iterations covariance"
    strain = "exx eyy exy sigma_exx sigma_eyy sigma_exy sigma_x_mm sigma_w_mm"
    assert set(f"{promised} {strain}".split()) <= listed
