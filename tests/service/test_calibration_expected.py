"""What is expected of a calibration beforehand, against ones really made; decisions on calibrations."""

from __future__ import annotations

import json
import math

import httpx
import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, CalibrationResult, CalibrationView, NominalValues, calibrate
from stereorig.core.calibration.expect import expect
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError
from stereorig.core.target import GridTarget
from stereorig.server.store.indexing.build import rebuild
from stereorig.server.workflows.service import Service
from tests.support.calibration_truth import PAPER, Grid, nodes, project

pytestmark = pytest.mark.timeout(300)
API = "/api/v1"


def test_the_expected_uncertainty_is_that_of_the_calibration_then_made() -> None:
    """Observations by the printed equations, with noise; the plan has the nominal cameras only."""
    rng = np.random.default_rng(3)
    noise, positions, held = 0.01, (-4.0, 0.0, 4.0), (2.0,)
    X, Y = nodes(Grid())
    views = [
        CalibrationView(cam, dz, project(c, X, Y, dz) + rng.normal(0, noise, (*X.shape, 2)))
        for cam, c in zip(("cam1", "cam2"), PAPER, strict=True)
        for dz in (*positions, *held)
    ]
    one, two = (
        NominalValues((512, 480), phd_px=12300.0, standoff_mm=404.0, angle_deg=angle, aspect=0.9617)
        for angle in (-30.0, 30.0)
    )
    target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03)
    # the views have no tilt of the axis and an exact aspect ratio; their priors would be most of the uncertainty
    exact = CalibrationOptions(held_out_mm=held, axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)
    made = calibrate(views, target, (one, two), exact)
    expected = expect(positions, target, (one, two), exact, noise_px=noise, roll_deg=45.0)
    assert expected.reasons == ()
    for name, sigma in made.sigma.items():
        assert 0.7 < expected.sigma[name] / sigma < 1.4, name
    assert expected.volume.shape_rms_mm == pytest.approx(made.uncertainty.shape_rms_mm, rel=0.25)
    assert expected.volume.scale == pytest.approx(made.uncertainty.scale, rel=0.25)
    assert expected.volume.centre_z_mm == pytest.approx(made.uncertainty.centre_z_mm, rel=0.25)
    # the middle and the corners, by derivatives taken here: numbers of a triangulation with shifted parameters
    assert expected.points_mm[0].tolist() == [0.0, 0.0, 0.0]
    assert {tuple(np.sign(p)) for p in expected.points_mm[1:]} == {
        (x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
    }
    sigma = _sigma_by_differences(made, expected.points_mm)
    assert expected.sigma_mm == pytest.approx(sigma, rel=0.5)
    # where the true cameras are off their nominal values by per cent, Z at the middle differs by as much
    assert math.isclose(expected.sigma_mm[0, 2], sigma[0, 2], rel_tol=0.3)


def _sigma_by_differences(made: CalibrationResult, points: np.ndarray) -> np.ndarray:
    cameras = [camera.paper_parameters() for camera in (made.pair.cam1, made.pair.cam2)]
    seen = [camera.project(points).xy for camera in (made.pair.cam1, made.pair.cam2)]
    slopes = np.zeros((len(points), 3, 20))
    for k, (name, sigma) in enumerate(made.sigma.items()):
        cam, parameter = name.split(".")
        ends = []
        for sign in (-1, 1):
            shifted = [dict(c) for c in cameras]
            shifted[0 if cam == "cam1" else 1][parameter] += sign * 0.01 * sigma
            pair = StereoPair(*(Camera.from_paper(**c) for c in shifted))
            ends.append(pair.triangulate(*seen).xyz_mm)
        slopes[:, :, k] = (ends[1] - ends[0]) / (0.02 * sigma)
    return np.sqrt(np.diagonal(slopes @ made.covariance @ np.swapaxes(slopes, 1, 2), axis1=1, axis2=2))


def test_twice_the_noise_is_twice_the_uncertainty_and_less_travel_more(client: httpx.Client) -> None:
    def expected_of(**body: object) -> dict[str, float]:
        answer = client.post("/api/v1/calibrations:expect", json=body)
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    usual, noisy = expected_of(noise_px=0.005), expected_of(noise_px=0.01)
    assert noisy["scale"] == pytest.approx(2 * usual["scale"], rel=1e-3)
    short = expected_of(positions_mm=[0.0, 0.2], held_out_mm=[])
    assert short["centre_px"] > 10 * usual["centre_px"]
    assert short["refused"] is True
    assert any("image centre" in text for text in short["reasons"])


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"positions_mm": [3.0]}, "calibration_underdetermined"),
        ({"positions_mm": [0.0, 5.0], "held_out_mm": [5.0]}, "positions_overlap"),
        ({"positions_mm": [0.0, 500.0], "held_out_mm": []}, None),
    ],
)
def test_a_plan_that_would_be_refused_is_refused_here_too(
    client: httpx.Client, body: dict[str, object], code: str | None
) -> None:
    answer = client.post("/api/v1/calibrations:expect", json=body)
    begun = client.post("/api/v1/calibrations", json=body)
    assert answer.status_code == begun.status_code
    assert answer.status_code in (409, 422)
    assert answer.json()["code"] == begun.json()["code"]
    assert code is None or answer.json()["code"] == code
    assert answer.json()["remedy"]


def test_cameras_that_do_not_see_the_target_are_told() -> None:
    near = NominalValues(image_size_px=(160, 144), phd_px=36000.0, standoff_mm=404.0, angle_deg=30.0)
    target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.1)
    with pytest.raises(CalibrationInputError) as caught:
        expect([0.0, 5.0], target, (near, near), CalibrationOptions())
    assert caught.value.code == "calibration_unseen"


@pytest.fixture(scope="module")
def calibration(client: httpx.Client) -> str:
    cameras = {
        f"cam{k}": {
            "phd_px": 3600.0,
            "cx_px": 80.0,
            "cy_px": 72.0,
            "kappa_per_px2": 0.0,
            "aspect": 0.96,
            "alpha_rad": 0.78,
            "beta_rad": 0.01,
            "gamma_rad": sign * 0.52,
            "x0_mm": 0.1,
            "y0_mm": 0.1,
            "z0_mm": 400.0,
        }
        for k, sign in ((1, -1), (2, 1))
    }
    sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))})
    assert sent.status_code == 201, sent.text
    return str(sent.json()["id"])


def test_decisions_are_kept_and_heeded(client: httpx.Client, calibration: str) -> None:
    none_accepted = client.post("/api/v1/tests", json={"name": "t", "calibration_id": "latest"})
    assert (none_accepted.status_code, none_accepted.json()["code"]) == (409, "no_calibration_accepted")
    where = f"/api/v1/calibrations/{calibration}/review"
    accepted = client.put(where, json={"decision": "accepted", "note": "fresh"}).json()
    assert accepted["review"]["decision"] == "accepted"
    assert accepted["review"]["by"] == "local"
    listed = {e["id"]: e for e in client.get("/api/v1/calibrations").json()["calibrations"]}
    assert listed[calibration]["decision"] == "accepted"
    test = client.post("/api/v1/tests", json={"name": "t", "calibration_id": "latest"})
    assert test.status_code == 201, test.text
    assert test.json()["calibration_id"] == calibration
    client.put(where, json={"decision": "discarded", "note": "the lamp was off"}).raise_for_status()
    refused = client.post("/api/v1/tests", json={"name": "t", "calibration_id": calibration})
    assert (refused.status_code, refused.json()["code"]) == (409, "calibration_discarded")
    assert "the lamp was off" in refused.json()["detail"]
    client.put(where, json={"decision": None}).raise_for_status()
    assert client.get(f"/api/v1/calibrations/{calibration}").json()["review"] is None
    assert client.post("/api/v1/tests", json={"name": "t", "calibration_id": calibration}).status_code == 201
    assert client.put("/api/v1/calibrations/c000099-aaaaaa/review", json={"decision": None}).status_code == 404


def test_the_decision_survives_a_rebuilt_index(client: httpx.Client, service: Service, calibration: str) -> None:
    client.put(f"/api/v1/calibrations/{calibration}/review", json={"decision": "accepted"}).raise_for_status()
    service.catalog.put_entry("calibration", "", calibration, {"id": calibration, "state": "unfinished"})
    rebuild(service.catalog, service.folder, service.calibrations, service.tests)
    entry = next(e for e in service.catalog.entries("calibration") if e["id"] == calibration)
    assert entry["decision"] == "accepted"


def test_a_noise_whose_square_is_nothing_is_refused(client: httpx.Client) -> None:
    for noise in (0.0, 1e-200, 5e-324):
        answer = client.post("/api/v1/calibrations:expect", json={"noise_px": noise})
        assert answer.status_code == 422, answer.text
        assert answer.json()["fields"][0]["field"] == "noise_px"
    assert client.post("/api/v1/calibrations:expect", json={"noise_px": 1e-6}).status_code == 200


def test_cameras_whose_pixels_do_not_see_the_targets_plane_are_refused(client: httpx.Client) -> None:
    answer = client.post("/api/v1/calibrations:expect", json={"rig": {"phd_px": 0.001}})
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] == "calibration_singular"
