"""Speckle quality against the scatter of a match with noise; seeds whose two positions are one point, or are not."""

from __future__ import annotations

import json
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.seeding.seeds import Seed, seeds_of
from stereorig.server.formats.results.layout import stored_settings
from stereorig.server.results.images.texture import errors_at, speckle_quality
from tests.support.service_rig import SMALL, new_test, true_cameras

pytestmark = pytest.mark.timeout(180)
API = "/api/v1"
HEIGHT, WIDTH = 240, 256


def speckle(seed: int, blur: float = 1.6, contrast: float = 45.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), blur)
    return np.asarray(128.0 + contrast * noise / noise.std())


@pytest.mark.parametrize("size", [15, 31])
def test_the_expected_error_is_the_scatter_that_noise_gives(size: int) -> None:
    texture, noise, rng = speckle(1), 4.0, np.random.default_rng(2)
    x, y, half = 120, 100, size // 2
    box = (slice(y - half, y + half + 1), slice(x - half, x + half + 1))
    gy, gx = (g[box].ravel() for g in np.gradient(texture))
    # a shift by least squares from two noisy images of the same thing: no shift but what noise makes
    design = np.column_stack([gx, gy])
    shifts = np.array(
        [np.linalg.lstsq(design, rng.normal(0, noise * 2**0.5, size * size), rcond=None)[0] for _ in range(2000)]
    )
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(shifts.T))[-1])
    noisy = texture + rng.normal(0, noise, texture.shape)
    estimated = errors_at(noisy, np.array([[x, y]], dtype=float), noise, (size,))[size][0]
    assert estimated == pytest.approx(worst, rel=0.15)


def test_no_texture_is_no_texture_and_lines_are_not_enough() -> None:
    points = np.array([[x, y] for x in range(60, 200, 10) for y in range(60, 180, 10)], dtype=float)
    flat = 128.0 + np.random.default_rng(3).normal(0, 2.0, (HEIGHT, WIDTH))
    rated = speckle_quality(flat, 255.0, points, 33)
    assert (rated.level, rated.proposed_subset_px, rated.good_share) == ("poor", None, 0.0)
    lines = np.tile(128.0 + 60.0 * np.sin(np.arange(WIDTH) / 2.0), (HEIGHT, 1))
    assert speckle_quality(lines, 255.0, points, 33).level == "poor"
    good = speckle_quality(speckle(4), 255.0, points, 33)
    assert good.level == "good"
    faint = speckle_quality(speckle(4, contrast=12.0), 255.0, points, 33)
    assert faint.median_error_px > 3 * good.median_error_px
    # the proposed size does what it is proposed for, and the next smaller one does not
    sizes = {row.subset_px: row.good_share for row in faint.sizes}
    proposed = faint.proposed_subset_px
    assert sizes[proposed] >= 0.95
    smaller = [share for size, share in sizes.items() if size < proposed]
    assert not smaller or smaller[-1] < 0.95
    assert good.proposed_subset_px < proposed


def test_seeds_of_settings_old_and_new() -> None:
    def seeds(**given: Any) -> Any:
        region = {"rectangle": [0, 0, 9, 9]}
        return seeds_of(stored_settings({"region": region, **given}))

    assert seeds(seeds=None) is None
    assert seeds(seeds=[[1.0, 2.0]]) == [Seed((1.0, 2.0))]  # an analysis from before
    assert seeds(seeds=[[1.0, 2.0], [3.0, 4.0]], seeds_cam2=[None, [5.0, 6.0]]) == [
        Seed((1.0, 2.0)),
        Seed((3.0, 4.0), (5.0, 6.0)),
    ]


@pytest.fixture(scope="module")
def cameras() -> dict[str, dict[str, float]]:
    return true_cameras(SMALL)


@pytest.fixture(scope="module")
def test_id(client: httpx.Client, cameras: dict[str, dict[str, float]]) -> str:
    sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))})
    assert sent.status_code == 201, sent.text
    made = new_test(client, name="speckle", calibration_id=sent.json()["id"])
    files = {}
    for cam, seed in (("cam1", 7), ("cam2", 8)):
        _, data = cv2.imencode(".png", np.clip(speckle(seed), 0, 255).astype(np.uint8))
        files[cam] = (f"{cam}.png", data.tobytes())
    assert client.post(f"{API}/tests/{made}/steps:import", files=files).status_code == 201
    return made


def problem(answer: httpx.Response) -> tuple[int, str]:
    assert answer.json()["remedy"]
    return answer.status_code, str(answer.json()["code"])


def test_texture_over_http(client: httpx.Client, test_id: str) -> None:
    where = f"{API}/tests/{test_id}/steps/0/texture"
    region = {"rectangle": [60, 60, 180, 170], "holes": [[[100, 100], [140, 100], [140, 140], [100, 140]]]}
    rated = client.post(where, json={"region": region, "subset_px": 33, "spacing_px": 10})
    assert rated.status_code == 200, rated.text
    assert rated.json()["subsets"] < 13 * 12  # none in the hole
    assert rated.json()["level"] == "good"
    quiet = client.post(where, json={"region": region, "noise_grey": 0.255}).json()
    assert quiet["median_error_px"] < 0.2 * rated.json()["median_error_px"]
    assert problem(client.post(where, json={"region": region, "subset_px": 34})) == (422, "subset_invalid")
    outside = {"rectangle": [600, 60, 700, 170]}
    assert problem(client.post(where, json={"region": outside})) == (422, "region_outside_image")
    assert client.post(f"{API}/tests/{test_id}/steps/7/texture", json={"region": region}).status_code == 404


def test_where_camera_2_may_see_a_seed(
    client: httpx.Client, test_id: str, cameras: dict[str, dict[str, float]]
) -> None:
    pair = StereoPair(*(Camera.from_paper(**cameras[cam]) for cam in ("cam1", "cam2")))
    point = np.array([[0.4, -0.7, 0.3]])
    one, two = (camera.project(point).xy[0].tolist() for camera in (pair.cam1, pair.cam2))
    where = f"{API}/tests/{test_id}/seeds:check"
    checked = client.post(
        where, json={"seeds": [one, one, one], "seeds_cam2": [two, None, [two[0], two[1] + 30]]}
    ).json()
    right, unknown, wrong = checked["seeds"]
    assert right["distance_px"] < 1e-3
    assert unknown["distance_px"] is None
    assert 5 < wrong["distance_px"] <= 30
    # the true position lies on the line that is drawn: between neighbouring points of it
    line = np.array(right["line_px"])
    assert len(line) > 10
    assert ((line >= 0) & (line <= [WIDTH - 1, HEIGHT - 1])).all()
    a, b = line[:-1], line[1:]
    along = np.clip(np.sum((two - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0, 1)
    assert np.linalg.norm(two - (a + along[:, None] * (b - a)), axis=1).min() < 0.2
    assert problem(client.post(where, json={"seeds": [one], "seeds_cam2": []})) == (422, "seeds_do_not_match")

    def begun(**body: Any) -> httpx.Response:
        region = {"rectangle": [80, 70, 180, 170]}
        return client.post(f"{API}/tests/{test_id}/analyses", json={"kind": "profile", "region": region, **body})

    off = begun(seeds=[one], seeds_cam2=[[two[0], two[1] + 30]])
    assert problem(off) == (422, "seed_off_epipolar")
    assert f"{wrong['distance_px']:.1f} px" in off.json()["detail"]
    assert problem(begun(seeds=[one], seeds_cam2=[[900.0, 10.0]])) == (422, "seed_outside")
    assert begun(seeds=[one], seeds_cam2=[two, two]).status_code == 422
    assert begun(seeds_cam2=[two]).status_code == 422
