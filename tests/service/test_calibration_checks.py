"""Checks of calibrations over the API: kept with the calibration, in the report; projected patterns."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tifffile

from stereorig.core.calibration import CalibrationOptions, calibrate
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.native import calibration_content
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.calibration_truth import NOMINAL, PAPER, Grid, make_views, project
from tests.support.grid_images import grid_image, paper_camera
from tests.support.service_rig import new_test

pytestmark = pytest.mark.timeout(300)
API = "/api/v1"
GRID = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03)
TARGET = {"pitch_mm": 1.0, "lines": [11, 11], "line_width_mm": 0.03}
TRUE = {"cam1": paper_camera(-29.0, alpha_deg=44.3), "cam2": paper_camera(30.5, alpha_deg=45.4)}


def tiff(image: Any) -> bytes:
    data = io.BytesIO()
    tifffile.imwrite(data, image)
    return data.getvalue()


def imported(client: httpx.Client, content: dict[str, Any]) -> str:
    files = {"file": ("calibration.json", json.dumps(content).encode())}
    answer = client.post(f"{API}/calibrations:import", files=files)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.fixture(scope="module")
def ids(client: httpx.Client) -> dict[str, str]:
    options = CalibrationOptions(lens="paper", axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)
    turned = [PAPER[0], {**PAPER[1], "beta": PAPER[1]["beta"] + np.radians(0.1)}]
    found = {}
    for name, seed, cameras in (("a", 1, PAPER), ("b", 2, PAPER), ("turned", 3, turned)):
        made = calibrate(make_views((0.0, 2.0, 4.0, 5.0), seed=seed, cameras=cameras), Grid(), NOMINAL, options)
        found[name] = imported(client, calibration_content(made, GRID))
    found["true"] = imported(client, {n: c.paper_parameters() for n, c in TRUE.items()})
    return found


def marks(half_mm: float) -> dict[str, list[list[float]]]:
    ends = [[project(c, x, 1.0, 0.0, 0.3).tolist() for x in (-half_mm, half_mm)] for c in PAPER]
    return {"cam1": ends[0], "cam2": ends[1]}


def made_checks(client: httpx.Client, calibration_id: str) -> dict[str, dict[str, Any]]:
    document = client.get(f"{API}/calibrations/{calibration_id}").json()
    return {entry["name"]: entry for entry in document["checks"]["made"]}


def test_a_known_distance_turns_not_checked_into_checked(client: httpx.Client, ids: dict[str, str]) -> None:
    path = f"{API}/calibrations/{ids['a']}"
    before = client.get(path)
    assert made_checks(client, ids["a"])["known_distance"]["made"] is False
    assert before.json()["kept_checks"] is None
    body = {"points_px": marks(3.0), "distance_mm": 6.0, "point_sigma_px": 0.01}
    answer = client.post(f"{path}/distance:check", json=body)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["agrees"] is True
    assert found["ratio"] == pytest.approx(1.0, abs=4.0 * found["sigma_mm"] / 6.0)
    entry = made_checks(client, ids["a"])["known_distance"]
    assert (entry["made"], entry["agrees"], entry["text"]) == (True, True, found["text"])
    after = client.get(path)
    assert after.json()["kept_checks"]["known_distance"]["ratio"] == found["ratio"]
    assert after.headers["ETag"] != before.headers["ETag"]
    # a later one takes its place, and says what is wrong
    found = client.post(f"{path}/distance:check", json={**body, "distance_mm": 6.1}).json()
    assert found["agrees"] is False
    assert "beyond 3 sigma" in made_checks(client, ids["a"])["known_distance"]["text"]
    assert made_checks(client, ids["b"])["known_distance"]["made"] is False


def test_the_data_folder_stays_sound_with_a_kept_check(
    client: httpx.Client, service: Service, ids: dict[str, str]
) -> None:
    body = {"points_px": marks(3.0), "distance_mm": 6.0}
    assert client.post(f"{API}/calibrations/{ids['turned']}/distance:check", json=body).status_code == 200
    found = [f for f in verify(service.folder.root).findings if ids["turned"] in f.path]
    assert found == []


def test_a_target_in_a_step_is_measured(client: httpx.Client, ids: dict[str, str]) -> None:
    test = new_test(client, calibration_id=ids["true"])
    files = {name: (f"{name}.tif", tiff(grid_image(camera, seed=3))) for name, camera in TRUE.items()}
    answer = client.post(f"{API}/tests/{test}/steps:import", files=files)
    assert answer.status_code == 201, answer.text
    path = f"{API}/calibrations/{ids['true']}/distance:check"
    step = {"test_id": test, "n": answer.json()["n"], "target": TARGET}
    found = client.post(path, json={"step": step}).json()
    assert found["points"] == 81
    assert found["agrees"] is True
    assert found["covariance_known"] is False
    # 0.003 px of noise at 33 um a pixel over 11 mm
    assert found["ratio"] == pytest.approx(1.0, abs=5e-5)
    found = client.post(path, json={"step": {**step, "target": {**TARGET, "pitch_mm": 1.004}}}).json()
    assert found["agrees"] is False
    board = {"kind": "checkerboard", "pitch_mm": 1.0, "size": [9, 6]}
    answer = client.post(path, json={"step": {**step, "target": board}})
    assert answer.status_code == 422
    assert answer.json()["code"].startswith("target_")


def test_requests_that_make_no_check_are_refused(client: httpx.Client, ids: dict[str, str]) -> None:
    path = f"{API}/calibrations/{ids['a']}/distance:check"
    for body in (
        {},
        {"points_px": marks(3.0)},
        {"distance_mm": 6.0},
        {"points_px": marks(3.0), "distance_mm": 6.0, "step": {"test_id": "t", "n": 0, "target": TARGET}},
    ):
        assert client.post(path, json=body).status_code == 422
    same = {"cam1": [[10.0, 10.0], [10.0, 10.0]], "cam2": [[10.0, 10.0], [10.0, 10.0]]}
    answer = client.post(path, json={"points_px": same, "distance_mm": 6.0})
    assert answer.json()["code"] == "known_distance_unusable"
    assert client.post(f"{API}/calibrations/c9/distance:check", json={}).status_code in (404, 422)


def test_two_calibrations_are_compared_in_space(client: httpx.Client, ids: dict[str, str]) -> None:
    def compared(one: str, other: str) -> dict[str, Any]:
        answer = client.get(f"{API}/calibrations/{ids[one]}/comparison", params={"with": ids[other]})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    found = compared("a", "b")
    assert (found["agrees"], found["degrees"]) == (True, 14)
    found = compared("a", "turned")
    assert found["agrees"] is False
    assert found["changes"]["explanations"][0]["cause"] == "camera_moved"
    found = compared("true", "true")
    assert (found["agrees"], found["chi_square"], found["shape_rms_mm"]["sigma"]) == (None, None, None)
    assert client.get(f"{API}/calibrations/{ids['a']}/comparison", params={"with": "c9"}).status_code == 404
    assert client.get(f"{API}/calibrations/{ids['a']}/comparison").status_code == 422


def test_the_aspect_ratio_of_uploaded_images(client: httpx.Client, service: Service) -> None:
    target = service.config.target
    assert target.lines is not None
    assert target.line_width_mm is not None
    grid = GridTarget(pitch_mm=target.pitch_mm, lines=target.lines, line_width_mm=target.line_width_mm)
    images = [
        ("images", (f"{k}.tif", tiff(grid_image(paper_camera(0.2, alpha_deg=a), target=grid, seed=k))))
        for k, a in enumerate((44.0, 45.0, 46.0))
    ]
    answer = client.post(f"{API}/calibrations:aspect", files=images, data={"standoff_mm": "400"})
    assert answer.status_code == 200, answer.text
    assert answer.json()["aspect"] == pytest.approx(0.9617, abs=1e-4)
    tilted = [("images", ("tilted.tif", tiff(grid_image(TRUE["cam1"], target=grid, seed=1))))]
    answer = client.post(f"{API}/calibrations:aspect", files=tilted)
    assert (answer.status_code, answer.json()["code"]) == (422, "aspect_not_normal")
    assert "tilted.tif" in answer.json()["detail"]


def test_displacement_under_a_projected_pattern_is_refused_with_the_reason(
    client: httpx.Client, ids: dict[str, str]
) -> None:
    test = new_test(client, calibration_id=ids["true"])
    files = {name: (f"{name}.tif", tiff(grid_image(camera, seed=3))) for name, camera in TRUE.items()}
    for _ in range(2):
        assert client.post(f"{API}/tests/{test}/steps:import", files=files).status_code == 201
    region = {"rectangle": [200, 200, 300, 300]}
    for more in (
        {"kind": "displacement"},
        {"strain": {"window": 5}},
        {"smoothing_window": 5},
        {"reference_update": "auto"},
    ):
        body = {"region": region, "pattern": "projected", **more}
        answer = client.post(f"{API}/tests/{test}/analyses", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, "pattern_projected"), answer.text
        assert "does not move with the surface" in answer.json()["detail"]
    answer = client.post(f"{API}/tests/{test}/analyses", json={"region": region, "pattern": "projected"})
    assert answer.status_code == 202, answer.text
    analysis = client.get(f"{API}/tests/{test}/analyses/{answer.json()['analysis_id']}").json()
    assert analysis["kind"] == "profile"
    assert analysis["settings"]["pattern"] == "projected"
    assert analysis["settings"]["strain"] is None


def test_a_kept_check_is_in_the_report_s_calibration(client: httpx.Client, service: Service, tmp_path: Path) -> None:
    from stereorig.server.documents.tests import TestRecord
    from stereorig.server.formats.calibrations.recognise import load_calibration
    from stereorig.server.report.calibration import CalibrationPart
    from stereorig.server.report.source import _with_kept_checks

    made = calibrate(make_views(), Grid(), NOMINAL, CalibrationOptions(lens="paper"))
    calibration_id = imported(client, calibration_content(made, GRID))
    test = new_test(client, calibration_id=calibration_id)
    body = {"points_px": marks(3.0), "distance_mm": 6.0}
    text = client.post(f"{API}/calibrations/{calibration_id}/distance:check", json=body).json()["text"]
    home = service.tests.path(test)  # the check came after the test took its copy of the calibration
    file = home / "calibration.json"
    loaded = load_calibration(file)
    with_checks = _with_kept_checks(loaded, file, home, TestRecord(id=test, calibration_id=calibration_id))
    assert f"known distance: {text}" in CalibrationPart(with_checks).made
