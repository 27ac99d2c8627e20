"""Metadata of a test: kept, replaced as a whole, guarded by If-Match; metadata of camera and lens in the rig file."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.config.camera_metadata import CameraMetadata, LensMetadata, merged
from stereorig.server.config.rig_file import parse_config
from stereorig.server.results.metadata import load_metadata, parse_metadata
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.service_rig import TINY, new_test, tiny_config

API = "/api/v1"
METADATA = {
    "operator": "Jörg <b>",
    "lighting": "two LED panels",
    "cam1": {"maker": "Basler", "pixel_um": 3.45, "lens": {"focal_length_mm": 50.0, "f_number": 8.0}},
    "static_steps": [1, 2],
    "gauges": {"extensometers": [{"name": "axial", "a_px": [60.0, 60.0], "b_px": [100.0, 60.0]}]},
}


def test_metadata_are_kept_in_the_tests_own_folder(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    url = f"{API}/tests/{test_id}/metadata"
    empty = client.get(url)
    assert (empty.status_code, empty.json()) == (200, {})
    put = client.put(url, json=METADATA)
    assert put.status_code == 200, put.text
    assert put.json()["cam1"] == METADATA["cam1"]
    again = client.get(url)
    assert again.json() == put.json()
    assert again.headers["etag"] == put.headers["etag"] != empty.headers["etag"]
    document = json.loads((service.tests.path(test_id) / "test.json").read_text())
    assert document["metadata"]["operator"] == "Jörg <b>"
    assert verify(service.folder.root).sound
    # the test's other fields are changed apart from them
    assert client.patch(f"{API}/tests/{test_id}", json={"notes": "n"}, headers={"If-Match": "*"}).status_code == 200
    assert client.get(url).json() == put.json()


def test_a_change_of_another_state_is_refused(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client)}/metadata"
    first = client.get(url).headers["etag"]
    assert client.put(url, json={"operator": "a"}, headers={"If-Match": first}).status_code == 200
    refused = client.put(url, json={"operator": "b"}, headers={"If-Match": first})
    assert refused.status_code == 412, refused.text
    assert refused.json()["code"] == "metadata_changed"
    assert client.get(url).json() == {"operator": "a"}
    assert client.put(url, json={"operator": "c"}, headers={"If-Match": refused.json()["etag"]}).status_code == 200
    assert client.put(url, json={}, headers={"If-Match": "*"}).json() == {}


@pytest.mark.parametrize(
    "body",
    [
        {"operater": "a"},
        {"operator": ""},
        {"standoff_mm": 0},
        {"standoff_mm": "far"},
        {"static_steps": [-1]},
        {"cam1": {"lens": {"f_number": -8}}},
        {"cam1": {"lense": {}}},
        {"gauges": {"extensometers": [{"a_px": [1, 2]}]}},
        {"operator": "x" * 501},
        {"cam1": {"lens": {"f_number": True}}},
        {"static_steps": [True]},
        {"standoff_mm": "3"},
        {"gauges": {"remove_rigid": {"robust": 1}}},
        [],
    ],
)
def test_metadata_that_cannot_be_are_refused(client: httpx.Client, body: object) -> None:
    answer = client.put(f"{API}/tests/{new_test(client)}/metadata", json=body)
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] == "invalid_request"


def test_no_facts_of_no_test(client: httpx.Client) -> None:
    assert client.get(f"{API}/tests/t000099-000000/metadata").status_code == 404
    assert client.put(f"{API}/tests/t000099-000000/metadata", json={}).status_code == 404


def test_a_file_of_facts(tmp_path: Path) -> None:
    path = tmp_path / "facts.toml"
    path.write_text('operator = "A"\nstatic_steps = [1]\n[cam2.lens]\nf_number = 5.6\n')
    metadata = load_metadata(path)
    assert metadata.cam2 == CameraMetadata(lens=LensMetadata(f_number=5.6))
    assert metadata.document() == {"operator": "A", "static_steps": [1], "cam2": {"lens": {"f_number": 5.6}}}
    for text, code in (("operator = ", "file_unreadable"), ("operater = 'A'", "metadata_invalid")):
        path.write_text(text)
        with pytest.raises(FileFormatError) as caught:
            load_metadata(path)
        assert caught.value.code == code
    with pytest.raises(FileFormatError, match=r"nothing\.toml"):
        load_metadata(tmp_path / "nothing.toml")
    with pytest.raises(FileFormatError, match="standoff_mm"):
        parse_metadata({"standoff_mm": "far"}, name="facts")


def test_the_tests_facts_go_before_the_rig_files() -> None:
    rig = {"maker": "Basler", "exposure_ms": 8.0, "lens": {"maker": "Zeiss", "f_number": 8.0}}
    combined = merged(CameraMetadata(maker="IDS", lens=LensMetadata(f_number=11.0)), rig)
    assert combined == CameraMetadata(maker="IDS", lens=LensMetadata(maker="Zeiss", f_number=11.0))
    assert merged(None, None) == CameraMetadata()


def test_a_captured_step_keeps_what_the_rig_file_tells(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0})
    answer = client.post(f"{API}/tests/{test_id}/steps", json={})
    assert answer.status_code == 201, answer.text
    rig = service.tests.steps.read(test_id, 0).document.plain()["rig"]
    assert (rig["name"], rig["simulated"], rig["trigger"], rig["lighting"]) == ("tiny rig", True, "software", None)
    assert rig["cameras"]["cam1"]["exposure_ms"] == pytest.approx(10.0)
    assert "lens" not in rig["cameras"]["cam1"]
    text = TINY.replace("exposure_ms = 10.0\n", "exposure_ms = 10.0\nmaker = 'M'\nlens = { f_number = 8.0 }\n", 1)
    assert parse_config(text).cam1.metadata() == CameraMetadata(maker="M", lens=LensMetadata(f_number=8.0))
    assert tiny_config().cam1.metadata() == CameraMetadata()
