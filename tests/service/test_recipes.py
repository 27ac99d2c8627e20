"""Recipes and workspaces: what is drawn and set is kept with its test, and can be taken by others."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.server.api.models.recipes import RECIPE_VERSION
from stereorig.server.cli import main
from stereorig.server.report.source import find_source
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.copied_tests import write_test_folder
from tests.support.problems import assert_problem
from tests.support.service_rig import TINY, new_test, served, tiny_config, true_cameras, wait_for_job

API = "/api/v1"
DRAWN: dict[str, Any] = {
    "image_size_px": [160, 144],
    "region": {
        "polygon": [[30.5, 30], [120, 31], [118, 110.2], [31, 112]],
        "holes": [[[60, 60], [70, 60], [70, 70]]],
        "cracks": [[[90, 40], [95, 80.5]]],
    },
    "settings": {
        "subset_px": 21,
        "spacing_px": 8,
        "patch": "affine",
        "seeds": [[50.0, 50.0]],
        "seeds_cam2": [None],
        "strain": {"window": 5},
    },
    "gauges": {
        "extensometers": [{"name": "e1", "a_px": [40, 50], "b_px": [110, 50]}],
        "areas": [{"name": "a1", "rectangle_px": [40, 40, 60, 60]}],
    },
    "display": {"field": "w_mm", "colours": "viridis", "limits": {"w_mm": [-0.1, 0.1]}},
    "drawing": {"holes": [[[1, 2]]], "anything": {"of": ["the page", None, 1.5]}},
}


def stated(document: dict[str, Any]) -> dict[str, Any]:
    return {"format": "stereorig recipe", "version": RECIPE_VERSION, **document}


def same(found: dict[str, Any], drawn: dict[str, Any]) -> None:
    """Equal, but for values that the document states although they were left out."""
    for name, value in drawn.items():
        if isinstance(value, dict):
            same(found[name], value)
        else:
            assert found[name] == value, name


def test_a_workspace_is_kept_as_it_is_drawn_and_is_there_after_a_restart(tmp_path: Path) -> None:
    for start in range(2):
        with Service(tiny_config(), tmp_path / "data") as service, served(service) as client:
            if start == 0:
                test_id = new_test(client)
                url = f"{API}/tests/{test_id}/workspace"
                empty = client.get(url)
                assert empty.json() == {}
                put = client.put(url, json=DRAWN, headers={"If-Match": empty.headers["etag"]})
                assert put.status_code == 200, put.text
                tag = put.headers["etag"]
            again = client.get(url)
            assert again.headers["etag"] == tag
            same(again.json(), stated(DRAWN))
            assert again.json()["drawing"] == DRAWN["drawing"]
            assert verify(service.folder.root).sound


def test_the_second_of_two_windows_is_told_that_the_first_has_drawn(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client)}/workspace"
    seen = client.get(url).headers["etag"]
    client.put(url, json={"note": "mine"}, headers={"If-Match": seen}).raise_for_status()
    refused = client.put(url, json={"note": "yours"}, headers={"If-Match": seen})
    assert_problem(refused, 412, "precondition_failed")
    assert client.get(url).json()["note"] == "mine"
    assert client.put(url, json={"note": "yours"}, headers={"If-Match": refused.json()["etag"]}).status_code == 200


def test_a_recipe_is_kept_listed_renamed_changed_and_deleted(service: Service, client: httpx.Client) -> None:
    made = client.post(f"{API}/recipes", json={"name": "strip", "recipe": DRAWN})
    assert made.status_code == 201, made.text
    url = f"{API}/recipes/{made.json()['id']}"
    assert_problem(client.post(f"{API}/recipes", json={"name": "strip", "recipe": {}}), 422, "recipe_name_taken")
    listed = client.get(f"{API}/recipes").json()["recipes"]
    assert [(one["name"], "recipe" in one) for one in listed] == [("strip", False)]
    read = client.get(url)
    same(read.json()["recipe"], stated(DRAWN))
    assert_problem(client.patch(url, json={"name": "panel"}), 428, "precondition_required")
    renamed = client.patch(url, json={"name": "panel"}, headers={"If-Match": read.headers["etag"]})
    assert renamed.json()["name"] == "panel"
    same(renamed.json()["recipe"], stated(DRAWN))
    assert verify(service.folder.root).sound
    assert client.delete(url).status_code == 204
    assert_problem(client.get(url), 404, "not_found")
    assert client.get(f"{API}/recipes").json()["recipes"] == []


BAD = {
    "a later version": ({"version": RECIPE_VERSION + 1}, "version", "invalid_request"),
    "another format": ({"format": "a song"}, "format", "invalid_request"),
    "an unknown field": ({"regoin": {}}, "regoin", "invalid_request"),
    "an unknown setting": ({"settings": {"subset": 21}}, "subset", "invalid_request"),
    "an even subset": ({"settings": {"subset_px": 20}}, "subset_px", "invalid_request"),
    "a region in the settings": ({"settings": {"region": {}}}, "region", "invalid_request"),
    "a region of one corner": ({"region": {"polygon": [[1, 2]]}}, "polygon", "invalid_request"),
    "a gauge without an end": ({"gauges": {"extensometers": [{"a_px": [1, 2]}]}}, "extensometers", "invalid_request"),
    "limits of text": ({"display": {"limits": {"w_mm": ["low", "high"]}}}, "limits", "invalid_request"),
    "another image": ({"image_size_px": [640, 480]}, "640 x 480", "recipe_other_size"),
    "a region outside": ({"region": {"rectangle": [10, 10, 300, 100]}}, "300", "recipe_outside"),
    "a seed outside": ({"settings": {"seeds": [[10, 200]]}}, "200", "recipe_outside"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A test's folder with one step of a plate."""
    made = tmp_path_factory.mktemp("taken") / "t000001-abcdef"
    write_test_folder(made, 1)
    return made


@pytest.fixture(scope="module")
def measurable(client: httpx.Client, folder: Path) -> str:
    """A test with a calibration and one step."""
    calibration = ("calibration.json", json.dumps(true_cameras(TINY)).encode())
    made = client.post(f"{API}/calibrations:import", files={"file": calibration}).json()["id"]
    test_id = new_test(client, calibration_id=made)
    files = {cam: (folder / "steps" / "0000" / f"{cam}.tif").read_bytes() for cam in ("cam1", "cam2")}
    sent = client.post(f"{API}/tests/{test_id}/steps:import", files={k: (f"{k}.tif", v) for k, v in files.items()})
    assert sent.status_code == 201, sent.text
    return test_id


@pytest.mark.parametrize("what", list(BAD))
def test_a_bad_workspace_is_refused_by_name_and_the_last_good_one_stays(
    client: httpx.Client, measurable: str, what: str
) -> None:
    change, word, code = BAD[what]
    url = f"{API}/tests/{measurable}/workspace"
    client.put(url, json={"note": "good"}).raise_for_status()
    refused = client.put(url, json=change)
    body = assert_problem(refused, 422, code)
    assert word in json.dumps(body)
    assert client.get(url).json()["note"] == "good"


def test_an_analysis_takes_what_it_leaves_out_from_a_recipe(client: httpx.Client, measurable: str) -> None:
    recipe = copy.deepcopy(DRAWN)
    recipe["region"] = {"rectangle": [60, 60, 90, 90]}
    recipe["settings"] = {"subset_px": 21, "spacing_px": 10, "kind": "profile", "max_sigma_px": 0.2}
    client.post(f"{API}/recipes", json={"name": "small", "recipe": recipe}).raise_for_status()
    answer = client.post(f"{API}/tests/{measurable}/analyses", json={"recipe": "small", "spacing_px": 15})
    assert answer.status_code == 202, answer.text
    assert wait_for_job(client, answer.json()["job"])["state"] == "succeeded"
    url = f"{API}/tests/{measurable}/analyses/{answer.json()['analysis_id']}"
    settings = client.get(url).json()["settings"]
    assert (settings["subset_px"], settings["spacing_px"], settings["max_sigma_px"]) == (21, 15, 0.2)
    assert settings["region"]["rectangle"] == [60, 60, 90, 90]
    # and its region and settings can be taken again
    again = client.get(f"{url}/recipe").json()
    assert again["region"] == {"rectangle": [60, 60, 90, 90], "outlines": [], "cracks": [], "holes": []}
    assert (again["settings"]["spacing_px"], again["settings"]["kind"]) == (15, "profile")
    assert again["image_size_px"] == [160, 144]
    assert client.put(f"{API}/tests/{measurable}/workspace", json=again).status_code == 200
    # refusals before anything is begun
    post = f"{API}/tests/{measurable}/analyses"
    assert_problem(client.post(post, json={"recipe": "none such"}), 404, "not_found")
    assert_problem(client.post(post, json={}), 422, "invalid_request")
    client.put(f"{API}/tests/{measurable}/workspace", json={"note": "no region"}).raise_for_status()
    assert_problem(client.post(post, json={"recipe": "workspace"}), 422, "recipe_invalid")


def test_the_command_line_takes_the_same_file_and_its_options_override_it(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    recipe = {
        **stated({"image_size_px": [160, 144]}),
        "region": {"polygon": [[50, 50], [95, 51], [80, 92.5]], "holes": [[[60, 60], [64, 60], [64, 64]]]},
        "gauges": {"points": [{"name": "middle", "xy_px": [75, 62]}]},
        "settings": {
            "subset_px": 25,
            "spacing_px": 12,
            "pattern": "projected",
            "max_sigma_px": 0.2,
            "seeds": [[80, 60]],
        },
    }
    file = tmp_path / "recipe.json"
    file.write_text(json.dumps(recipe))
    arguments = ["measure", str(folder), "--recipe", str(file), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--subset", "21", "--interpolation", "cubic"]) == 0
    settings = json.loads((tmp_path / "out" / "summary.json").read_text())["settings"]
    # the report of this folder reads the gauges without being told of the recipe
    (point,) = (find_source(tmp_path / "out").metadata.gauges or GaugeRequest()).points
    assert (point.name, point.xy_px) == ("middle", (75.0, 62.0))
    assert (settings["subset_px"], settings["interpolation"]) == (21, "cubic")  # of the command line
    assert (settings["spacing_px"], settings["max_sigma_px"], settings["pattern"]) == (12, 0.2, "projected")
    assert settings["region"]["polygon"] == recipe["region"]["polygon"]
    assert settings["region"]["holes"] == recipe["region"]["holes"]
    assert settings["seeds"] == [[80, 60]]
    capfd.readouterr()
    for change, code, word in (
        ({"version": RECIPE_VERSION + 1}, "recipe_invalid", f"version {RECIPE_VERSION + 1}"),
        ({"image_size_px": [640, 480]}, "recipe_other_size", "640 x 480"),
        ({"regions": []}, "recipe_invalid", "regions"),
    ):
        file.write_text(json.dumps({**recipe, **change}))
        assert main([*arguments[:-1], str(tmp_path / "other")]) == 1
        said = capfd.readouterr().err
        assert code in said
        assert word in said
        assert not (tmp_path / "other").exists()
    file.write_text("{")
    assert main(arguments) == 1
    assert "recipe_invalid" in capfd.readouterr().err
