"""The lists that the site puts into the pages of docs/reference are those of the program."""

from __future__ import annotations

import re

import pytest

from docs.built import LISTS, PLACE, filled, results, settings
from stereorig.core.settings import AnalysisSettings
from stereorig.core.status import PointStatus
from stereorig.server.api.app import bare_app
from tests.support.requirements import ROOT

FOLDER = ROOT / "docs" / "reference"


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """Every page as it is written, by its path."""
    return {str(p.relative_to(FOLDER)): p.read_text(encoding="utf-8") for p in sorted(FOLDER.rglob("*.md"))}


def test_every_list_has_its_place_and_every_place_its_list(pages: dict[str, str]) -> None:
    places = [place for text in pages.values() for place in PLACE.finditer(text)]
    assert {place["what"] for place in places if not place["name"]} == set(LISTS)
    for text in pages.values():
        assert "Here the built site" not in filled(text)


def test_every_tag_of_the_api_has_a_page_with_its_operations(pages: dict[str, str]) -> None:
    described = bare_app().openapi()
    assert {f"api/{tag['name']}.md" for tag in described["tags"]} == {path for path in pages if path.startswith("api/")}
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            row = f"| {method.upper()} `{path.removeprefix('/api/v1')}` |"
            assert row in filled(pages[f"api/{operation['tags'][0]}.md"])


def test_every_status_has_a_remedy_and_every_key_a_meaning(pages: dict[str, str]) -> None:
    assert set(results.REMEDIES) == set(PointStatus)
    table = pages["result_files.md"].partition("## `calibration.json`")[2]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == results.written_keys() | {"repair"}


def test_the_options_named_for_settings_are_settings() -> None:
    without = {"start_from", "side_by_side"}  # of the service alone
    assert set(settings.OPTIONS) == set(AnalysisSettings.model_fields) - without


def test_the_variables_that_scripts_rely_on_are_listed() -> None:
    listed = {name for name, *_ in results.variables()}
    promised = "x_px y_px x_mm y_mm z_mm u_mm v_mm w_mm normal_x status zncc epipolar_px iterations covariance"
    strain = "exx eyy exy sigma_exx sigma_eyy sigma_exy sigma_x_mm sigma_w_mm"
    assert set(f"{promised} {strain}".split()) <= listed
