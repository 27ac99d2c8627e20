"""A pair that was calibrated elsewhere, measured through the service: import of the calibration and of images."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from stereorig.server.formats.calibrations.recognise import load_calibration, parse_calibration
from stereorig.server.formats.images import decode_image, encode_tiff
from stereorig.server.formats.results.reading import read_head
from stereorig.server.workflows.service import Service
from tests.support.service_rig import new_test, served, tiny_config, wait_for_job
from tests.support.written_tiffs import HEIGHT, WIDTH, tiff

API = "/api/v1"
OURS = {
    "phd_px": 1000.0,
    "cx_px": 64.0,
    "cy_px": 64.0,
    "kappa_per_px2": 0.0,
    "aspect": 1.0,
    "alpha_rad": 0.0,
    "beta_rad": 0.0,
    "gamma_rad": 0.0,
    "x0_mm": 0.0,
    "y0_mm": 0.0,
    "z0_mm": 100.0,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("import") / "data"


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[httpx.Client]:
    service = Service(tiny_config(), folder).start()
    try:
        with served(service) as made:
            yield made
    finally:
        service.close()


def imported(client: httpx.Client, content: bytes, **more: Any) -> httpx.Response:
    return client.post(f"{API}/calibrations:import", files={"file": ("a", content)}, **more)


def ours(**more: Any) -> dict[str, Any]:
    return {"cam1": dict(OURS), "cam2": dict(OURS) | {"x0_mm": -20.0}, **more}


def refused(answer: httpx.Response, status: int, code: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["code"] == code
    assert answer.json()["remedy"]


def test_specimen_is_measured_with_an_imported_calibration(
    client: httpx.Client, folder: Path, specimen_dir: Path, tmp_path: Path
) -> None:
    xml = specimen_dir / "calibration_dice.xml"
    answer = imported(client, xml.read_bytes(), data={"label": "DICe"})
    assert answer.status_code == 201, answer.text
    calibration = answer.json()
    assert calibration["state"] == "complete"
    test_id = client.post(f"{API}/tests", json={"name": "D", "calibration_id": calibration["id"]}).json()["id"]
    for n in (0, 1):
        files = {cam: (cam, (specimen_dir / f"000{n}_{k}.tif").read_bytes()) for k, cam in enumerate(("cam1", "cam2"))}
        step = client.post(f"{API}/tests/{test_id}/steps:import", files=files)
        assert step.status_code == 201, step.text
    body = {"kind": "displacement", "region": {"rectangle": [800, 500, 1000, 620]}, "spacing_px": 20}
    accepted = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
    done = wait_for_job(client, accepted["job"])
    assert done["state"] == "succeeded", done["problem"]
    url = f"{API}/tests/{test_id}/analyses/{accepted['analysis_id']}"
    status = np.array(client.get(f"{url}/steps/1/fields/status").json()["values"])
    assert (status == 0).mean() > 0.97
    epipolar = np.array(client.get(f"{url}/steps/0/fields/epipolar_px").json()["values"], dtype=float)
    assert np.sqrt(np.nanmean(epipolar**2)) < 0.1  # DICe's calibration is off by 0.08 px in this part of the face
    # an import's system frame is its camera 1, and results say so
    stored = folder / "tests" / test_id / "analyses" / accepted["analysis_id"] / "step_0001.nc"
    assert read_head(stored).frame.startswith("sys = camera 1")
    # the copy in the test's folder is the same pair to the last bit
    kept, original = (load_calibration(p) for p in (folder / "tests" / test_id / "calibration.json", xml))
    np.testing.assert_array_equal(kept.pair.cam2_from_cam1.translation_mm, original.pair.cam2_from_cam1.translation_mm)
    assert kept.image_size1_px == original.image_size1_px == (1920, 1200)
    refused(client.get(f"{API}/calibrations/{calibration['id']}/residuals"), 404, "not_found")
    assert client.get(f"{API}/calibrations/{calibration['id']}/views").json() == {"views": []}
    # and can be taken to another data folder
    again = imported(client, client.get(f"{API}/calibrations/{calibration['id']}/file").content)
    assert again.status_code == 201, again.text
    assert again.json()["imported"] == calibration["imported"]


def test_our_own_calibration_is_carried_over_and_cannot_speak_for_the_service(client: httpx.Client) -> None:
    content = ours(verdict={"level": "good", "reasons": []}, plan=3, taken="x", id="c1", state="failed", problem=[1])
    answer = imported(client, json.dumps(content).encode())
    assert answer.status_code == 201, answer.text
    shown = client.get(f"{API}/calibrations/{answer.json()['id']}").json()
    assert shown["id"] == answer.json()["id"]
    assert shown["state"] == "complete"
    assert shown["problem"] is None
    assert shown["cam2"]["x0_mm"] == -20.0
    listed = client.get(f"{API}/calibrations").json()["calibrations"]
    assert shown["id"] in [c["id"] for c in listed]


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "calibration_unreadable"),
        (b"phd_px 12000\n", "calibration_unreadable"),
        (b"[" * 100000, "calibration_unreadable"),
        (json.dumps(ours()).replace('"checks"', "").replace("1000.0", "NaN").encode(), "calibration_invalid"),
        (json.dumps({"cam1": OURS, "cam2": OURS}).encode(), "calibration_invalid"),
        (json.dumps({"cam1": OURS}).encode(), "calibration_unreadable"),
        (json.dumps(ours(target=json.loads("[" * 200 + "]" * 200))).encode(), "calibration_unreadable"),
        (json.dumps({"imported": {"text": '{"imported": {}}'}}).encode(), "calibration_unreadable"),
        (json.dumps({"imported": 3}).encode(), "calibration_unreadable"),
        (b"<matrix cameraMatrix1 \xff\xfe", "calibration_unreadable"),
    ],
)
def test_what_is_no_calibration_is_refused_and_leaves_none(client: httpx.Client, data: bytes, code: str) -> None:
    before = client.get(f"{API}/calibrations").json()
    refused(imported(client, data), 422, code)
    assert client.get(f"{API}/calibrations").json() == before


def test_a_body_without_a_file_is_refused(client: httpx.Client) -> None:
    refused(client.post(f"{API}/calibrations:import", json={"file": "x"}), 422, "invalid_request")


def test_the_same_import_sent_again_makes_one_calibration(client: httpx.Client) -> None:
    data, key = json.dumps(ours()).encode(), {"Idempotency-Key": "import-1"}
    first, again = (imported(client, data, headers=key) for _ in range(2))
    assert first.json() == again.json()
    refused(imported(client, data + b" ", headers=key), 409, "idempotency_key_reused")


@pytest.mark.fault(17)
def test_images_of_another_size_than_the_calibrations_are_refused_when_they_come(client: httpx.Client) -> None:
    sizes = {"cam1": [128, 128], "cam2": [128, 128]}
    calibration = imported(client, json.dumps(ours(image_size_px=sizes)).encode()).json()["id"]
    test_id = client.post(f"{API}/tests", json={"name": "x", "calibration_id": calibration}).json()["id"]
    rng = np.random.default_rng(1)
    for shapes in (((128, 128), (128, 120)), ((100, 90), (100, 90))):
        images = [encode_tiff(rng.integers(0, 255, shape, dtype=np.uint8)) for shape in shapes]
        files = {cam: (cam, image) for cam, image in zip(("cam1", "cam2"), images, strict=True)}
        refused(client.post(f"{API}/tests/{test_id}/steps:import", files=files), 422, "image_size_mismatch")
    refused(client.post(f"{API}/tests/{test_id}/steps", json={}), 422, "image_size_mismatch")
    assert client.get(f"{API}/tests/{test_id}").json()["steps"] == []


def test_an_address_in_place_of_a_file_is_refused_in_plain_words(client: httpx.Client) -> None:
    form = {"cam1": "s3://bucket/left_0000.tif", "cam2": "s3://bucket/right_0000.tif"}
    answer = client.post(f"{API}/tests/{new_test(client)}/steps:import", data=form)
    assert answer.status_code == 422
    assert "cam1: Input should be a file, got 's3://bucket/left_0000.tif'." in answer.json()["detail"]
    assert "class" not in answer.json()["detail"]


def test_a_calibration_in_metres_is_asked_about_and_its_unit_is_taken(client: httpx.Client) -> None:
    matrix, lens = "[[1400, 0, 64], [0, 1400, 64], [0, 0, 1]]", "[0, 0, 0, 0, 0]"
    text = (
        f"M1: {matrix}\nD1: {lens}\nM2: {matrix}\nD2: {lens}\nR: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nT: [-0.08, 0, 0]\n"
    )
    asked = imported(client, text.encode()).json()["plan"]["check"]
    assert any("a baseline of 0.08 mm? It seems to be in metres." in warning for warning in asked["warnings"])
    made = imported(client, text.encode(), data={"unit": "m"}).json()
    assert made["plan"]["check"]["baseline_mm"] == pytest.approx(80.0)
    assert not any("unit of T" in warning for warning in made["plan"]["check"]["warnings"])
    file = client.get(f"{API}/calibrations/{made['id']}/file").content
    assert parse_calibration(file, name="a").pair.baseline_mm == pytest.approx(80.0)
    refused(imported(client, file, data={"unit": "mm"}), 422, "calibration_unit_conflict")
    refused(imported(client, text.encode(), data={"unit": "ell"}), 422, "calibration_unit_unknown")
    half = text[text.index("R:") :]
    answer = imported(client, f"# opencv\n{half}".encode())
    refused(answer, 422, "calibration_unreadable")
    assert "M1 D1 M2 D2 are in the other" in answer.text


def test_twelve_packed_bits_are_imported_with_their_own_full_scale(client: httpx.Client) -> None:
    rng = np.random.default_rng(4)
    scenes = [cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 1.5) for _ in range(2)]
    images = [
        cv2.normalize(scene, None, 400, 5000, cv2.NORM_MINMAX).clip(0, 4095).astype(np.uint16) for scene in scenes
    ]
    files = {
        cam: (cam, tiff(image[..., None], 12, "strips", "none", "<", planar=False, big=False, differences=False))
        for cam, image in zip(("cam1", "cam2"), images, strict=True)
    }
    test_id = new_test(client)
    step = client.post(f"{API}/tests/{test_id}/steps:import", files=files).json()
    assert step["quality"]["code"] == "saturated"
    assert step["quality"]["cam1"]["saturated_share"] == pytest.approx(np.mean(images[0] == 4095), abs=1e-5)
    kept = client.get(f"{API}/tests/{test_id}/steps/0/cam1").content
    np.testing.assert_array_equal(decode_image(kept), images[0])
