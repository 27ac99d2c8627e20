"""A camera was bumped: the command line and the API tell it, and repair the calibration beside the old one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES
from stereorig.server.cli import main
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import encode_tiff, write_image
from stereorig.server.workflows.service import Service
from tests.support.bumped_rig import SIZE, core_pair, picture, plain_camera, turned
from tests.support.service_rig import served, tiny_config, wait_for_job

API = "/api/v1"
CAM1, CAM2 = plain_camera(-1.0), plain_camera(1.0)
BUMP = (0.1, 0.2, -0.05)
BUMPED = turned(CAM2, BUMP)
ROI = (60, 60, 740, 580)


@lru_cache(maxsize=8)
def seen(camera: int, *, bumped: bool, pose: int = 0) -> np.ndarray:
    who = CAM1 if camera == 1 else BUMPED if bumped else CAM2
    return picture(who, pose, seed=10 * pose + camera + 100 * bumped, n=2)


def calibration() -> dict[str, Any]:
    """The cameras before the bump, with a covariance."""
    pair = core_pair(CAM1, CAM2)
    names = [f"{cam}.{name}" for cam in ("cam1", "cam2") for name in TEN_PARAMETER_NAMES]
    sigma = [0.06, 0.06, 0.06, 2e-11, 4e-6, 4e-6, 4e-6, 2e-3, 2e-3, 2e-2] * 2
    return {
        "format": "stereorig calibration",
        "format_version": 1,
        "cam1": pair.cam1.paper_parameters(),
        "cam2": pair.cam2.paper_parameters(),
        "image_size_px": {"cam1": list(SIZE), "cam2": list(SIZE)},
        "covariance": {"names": names, "matrix": np.diag(np.square(sigma)).tolist()},
        "sigma": dict(zip(names, sigma, strict=True)),
        "checks": {"held_out": {"rbe_px": 0.004}},
        "verdict": {"level": "good", "reasons": []},
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "calibration.json").write_text(json.dumps(calibration()))
    for n, (bumped, pose) in enumerate(((True, 0), (True, 1), (False, 0))):
        for camera in (1, 2):
            write_image(tmp_path / f"cam{camera}_{n}.tif", seen(camera, bumped=bumped, pose=pose))
    return tmp_path


def repair(folder: Path, *more: str, out: str = "repaired.json", steps: tuple[int, ...] = (0, 1)) -> int:
    images = [a for n in steps for a in ("--images", str(folder / f"cam1_{n}.tif"), str(folder / f"cam2_{n}.tif"))]
    arguments = ["calibration", "repair", str(folder / "calibration.json"), *images, "--out", str(folder / out)]
    return main([*arguments, "--roi", ",".join(map(str, ROI)), *more])


def measure(folder: Path, steps: str, calibration: str) -> int:
    images = [x for c in (1, 2) for x in (f"--cam{c}", str(folder / f"cam{c}_[{steps}].tif"))]
    more = ["--roi", ",".join(map(str, ROI)), "--step", "20", "--strain", "off", "--out", str(folder / "out")]
    return main(["measure", *images, "--calibration", str(folder / calibration), *more])


def test_the_command_line_repairs_beside_the_old_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "calibration.json").read_bytes()
    assert repair(folder) == 0
    printed = capsys.readouterr().out
    assert "camera 2 turned against camera 1" in printed
    assert "+-" in printed
    assert (folder / "calibration.json").read_bytes() == before
    made = json.loads((folder / "repaired.json").read_text())
    found = made["repair"]
    np.testing.assert_allclose(found["change_deg"][:3], BUMP, atol=2e-3)  # several of its uncertainties
    assert found["offset_before_px"] > 2.0
    assert found["offset_after_px"] < 0.002
    assert found["original_sha256"] == hashlib.sha256(before).hexdigest()
    image = folder / "cam2_1.tif"
    assert found["images"][1]["cam2"]["sha256"] == hashlib.sha256(image.read_bytes()).hexdigest()
    assert made["verdict"]["level"] == "warning"
    assert "estimated again" in made["verdict"]["reasons"][-1]
    old = calibration()
    assert made["cam1"] == old["cam1"]
    lens = ("phd_px", "cx_px", "cy_px", "kappa_per_px2", "aspect")
    assert {k: made["cam2"][k] for k in lens} == {k: old["cam2"][k] for k in lens}
    # only camera 2's pose is less certain than it was
    sigma = np.sqrt(np.diag(made["covariance"]["matrix"]))
    ratio = sigma / np.array(list(old["sigma"].values()))
    np.testing.assert_allclose(ratio[:14], 1.0, rtol=1e-9)
    assert (ratio[14:] > 1.5).all()
    assert made["sigma"]["cam2.gamma_rad"] == pytest.approx(sigma[16])
    pair = load_calibration(folder / "repaired.json").pair
    assert pair.baseline_mm == pytest.approx(core_pair(CAM1, CAM2).baseline_mm, rel=1e-12)

    # measured with it: no camera has moved since; and the first step before the bump is told as such
    assert measure(folder, "01", "repaired.json") == 0
    steps = json.loads((folder / "out" / "summary.json").read_text())["steps"]
    assert [step["camera_motion"]["camera_moved"] for step in steps] == [False, False]
    assert steps[1]["camera_motion"]["reference"]["camera_moved"] is False
    assert "no camera moved" in capsys.readouterr().err
    assert measure(folder, "02", "repaired.json") == 1
    assert "camera_moved" in capsys.readouterr().err


def test_a_repair_is_refused_with_its_reason(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more, code in (
        (["--max-turn", "0.1"], "repair_too_large"),
        (["--max-strain", "0.5"], "repair_uncertain"),
        (["--step", "100", "--roi", "60,60,260,260"], "repair_too_few_points"),
    ):
        assert repair(folder, *more, steps=(0,)) == 1
        assert code in capsys.readouterr().err
        assert not (folder / "repaired.json").exists()
    assert repair(folder, out="calibration.json") == 1
    assert "output_is_input" in capsys.readouterr().err
    assert repair(folder, steps=()) == 1
    assert "option_conflict" in capsys.readouterr().err


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    service = Service(tiny_config(), tmp_path_factory.mktemp("repair") / "data").start()
    try:
        with served(service) as made:
            yield made
    finally:
        service.close()


@pytest.fixture(scope="module")
def original(client: httpx.Client) -> str:
    files = {"file": ("calibration.json", json.dumps(calibration()).encode())}
    answer = client.post(f"{API}/calibrations:import", files=files)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.fixture(scope="module")
def bumped_test(client: httpx.Client, original: str) -> str:
    test_id = client.post(f"{API}/tests", json={"name": "bumped", "calibration_id": original}).json()["id"]
    for pose in (0, 1):
        files = {f"cam{c}": (f"cam{c}", encode_tiff(seen(c, bumped=True, pose=pose))) for c in (1, 2)}
        assert client.post(f"{API}/tests/{test_id}/steps:import", files=files).status_code == 201
    return str(test_id)


def ask(client: httpx.Client, calibration_id: str, **body: Any) -> httpx.Response:
    return client.post(f"{API}/calibrations/{calibration_id}:repair", json=body)


def test_the_api_makes_a_new_calibration_and_keeps_the_old(
    client: httpx.Client, original: str, bumped_test: str
) -> None:
    before = client.get(f"{API}/calibrations/{original}/file").content
    asked = ask(client, original, test_id=bumped_test, steps=[0, 1], region={"rectangle": list(ROI)}, label="after")
    assert asked.status_code == 202, asked.text
    done = wait_for_job(client, asked.json()["job"])
    assert done["state"] == "succeeded", done["problem"]
    new_id = asked.json()["calibration_id"]
    made = client.get(f"{API}/calibrations/{new_id}").json()
    assert made["state"] == "complete"
    assert made["plan"]["repaired_from"] == original
    assert made["plan"]["steps"] == [0, 1]
    np.testing.assert_allclose(made["repair"]["change_deg"][:3], BUMP, atol=2e-3)
    assert client.get(f"{API}/calibrations/{original}/file").content == before

    test_id = client.post(f"{API}/tests", json={"name": "after", "calibration_id": new_id}).json()["id"]
    for pose in (0, 1):
        files = {f"cam{c}": (f"cam{c}", encode_tiff(seen(c, bumped=True, pose=pose))) for c in (1, 2)}
        client.post(f"{API}/tests/{test_id}/steps:import", files=files)
    body = {"region": {"rectangle": list(ROI)}, "spacing_px": 24, "strain": None}
    accepted = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
    assert wait_for_job(client, accepted["job"])["state"] == "succeeded"
    steps = client.get(f"{API}/tests/{test_id}/analyses/{accepted['analysis_id']}").json()["summary"]["steps"]
    for step in steps:
        motion = step["camera_motion"]
        assert motion["camera_moved"] is False
        assert motion["calibration"]["offset_rms_px"] < 0.005
        assert motion["calibration"]["consequence"]["shape_um"] is not None
    assert steps[0]["camera_motion"]["reference"] is None
    assert steps[1]["camera_motion"]["reference"]["against"] == "reference"


def test_a_repair_that_does_not_hold_leaves_its_reason(client: httpx.Client, original: str, bumped_test: str) -> None:
    asked = ask(client, original, test_id=bumped_test, steps=[0], max_turn_deg=0.1)
    done = wait_for_job(client, asked.json()["job"])
    assert done["state"] == "failed"
    assert done["problem"]["code"] == "repair_too_large"
    made = client.get(f"{API}/calibrations/{asked.json()['calibration_id']}").json()
    assert made["state"] == "failed"
    assert made["problem"]["code"] == "repair_too_large"
    for answer, status, code in (
        (ask(client, "c999999-000000", test_id=bumped_test, steps=[0]), 404, "not_found"),
        (ask(client, original, test_id=bumped_test, steps=[7]), 404, "not_found"),
        (ask(client, original, test_id=bumped_test, steps=[]), 422, "invalid_request"),
    ):
        assert answer.status_code == status, answer.text
        assert answer.json()["code"] == code
