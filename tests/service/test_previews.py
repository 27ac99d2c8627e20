"""Previews and maps: against numbers made by hand."""

from __future__ import annotations

import io

import httpx
import numpy as np
import pytest
from PIL import Image

from stereorig.server.results.images.previews import (
    GOOD_PX,
    NOISE_SHARE,
    eight_bit,
    predicted_error_px,
    preview,
    saturation_map,
    texture_map,
)


def picture(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))


def test_a_preview_of_12_bit_is_as_bright_as_the_image() -> None:
    pixels = np.full((40, 60), 2048, np.uint16)
    assert abs(int(picture(preview(pixels, 4095.0)).mean()) - 128) <= 1
    assert picture(preview(pixels, 4095.0, 30)).shape == (20, 30)
    # never larger than the image
    assert picture(preview(pixels, 4095.0, 600)).shape == (40, 60)
    assert eight_bit(np.array([[0, 4095]], np.uint16), 4095.0).tolist() == [[0, 255]]


def test_saturated_pixels_are_red_and_others_clear() -> None:
    pixels = np.full((40, 60), 100, np.uint8)
    pixels[10, 20] = 255
    made = saturation_map(pixels, 255.0)
    rgba = picture(made.png)
    assert rgba.shape == (40, 60, 4)
    assert rgba[10, 20, 0] == 255
    assert rgba[10, 20, 3] > 200
    assert rgba[30, 40, 3] == 0
    assert "0.0417 %" in made.legend


def test_predicted_error_is_the_one_that_shifting_images_shows() -> None:
    """A known pattern, noise, and the least squares shift of each window: their scatter is the truth."""
    rng = np.random.default_rng(5)
    rows, cols, subset = 192, 192, 33
    y, x = np.mgrid[:rows, :cols].astype(float)

    def scene(shift: float) -> np.ndarray:
        waves = np.zeros((rows, cols))
        for k, (fx, fy) in enumerate([(0.09, 0.02), (0.03, 0.11), (0.07, -0.08), (-0.05, 0.1)]):
            waves += np.sin(2 * np.pi * (fx * (x - shift) + fy * y) + k)
        return 128.0 + 15.0 * waves

    clean = scene(0.0)
    gx = (scene(-0.01) - scene(0.01)) / 0.02
    gy = np.gradient(clean, axis=0)
    noise = NOISE_SHARE * 255.0
    predicted = predicted_error_px(np.round(clean).astype(np.uint8), 255.0, subset)
    spacing = 192 // 64
    row, col = 96, 96
    window = np.s_[row - 16 : row + 17, col - 16 : col + 17]
    g = np.stack([gx[window].ravel(), gy[window].ravel()], axis=1)
    shifts = []
    for _ in range(4000):
        difference = rng.normal(0.0, noise * np.sqrt(2.0), g.shape[0])
        shifts.append(np.linalg.lstsq(g, difference, rcond=None)[0])
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(shifts).T))[-1])
    # its own centre differences see 0.9 of the steepest waves
    assert predicted[(row - 1) // spacing, (col - 1) // spacing] == pytest.approx(worst, rel=0.15)


def test_texture_in_one_direction_only_or_none_is_red() -> None:
    x = np.arange(128)
    lines = np.tile((128 + 80 * np.sin(x / 2.0)).astype(np.uint8), (128, 1))
    for pixels in (lines, np.full((128, 128), 90, np.uint8)):
        assert not np.isfinite(predicted_error_px(pixels, 255.0, 33)).any()
        rgba = picture(texture_map(pixels, 255.0, 33).png)
        assert (rgba[..., 0] > 200).all()
        assert (rgba[..., 1] < 100).all()
    speckle = np.random.default_rng(1).integers(0, 255, (128, 128)).astype(np.uint8)
    assert (predicted_error_px(speckle, 255.0, 33) < GOOD_PX).all()


def test_over_http(client: httpx.Client) -> None:
    client.put("/api/v1/sim/scene", json={"scene": "plate"}).raise_for_status()
    test_id = client.post("/api/v1/tests", json={"name": "looks"}).json()["id"]
    client.post(f"/api/v1/tests/{test_id}/steps", json={"label": "zero"}).raise_for_status()
    step = f"/api/v1/tests/{test_id}/steps/0/cam1"
    stored = picture(client.get(step, params={"format": "png"}).content)
    seen = client.get(f"{step}/preview")
    assert seen.headers["Content-Type"] == "image/jpeg"
    assert np.abs(picture(seen.content).astype(float) - stored).mean() < 4.0
    assert picture(client.get(f"{step}/preview", params={"width_px": 80}).content).shape == (72, 80)
    laid = client.get(f"{step}/maps/texture", params={"subset_px": 21})
    assert "subset of 21 px" in laid.headers["X-Legend"]
    assert picture(laid.content).shape[2] == 4
    corner = {"x_px": 150, "y_px": 140, "columns": 64, "rows": 3}
    answer = client.get(f"{step}/pixels", params=corner).json()
    assert answer["values"] == stored[140:143, 150:160].tolist()
    assert (answer["x_px"], answer["y_px"], answer["grey_scale"], answer["full_scale"]) == (150, 140, 1.0, 255.0)
    assert client.get(f"{step}/pixels", params=corner | {"x_px": 160}).json()["code"] == "invalid_input"
    assert client.get(f"{step}/pixels", params=corner | {"columns": 257}).status_code == 422
    # frames averaged are stored finer than a grey level
    client.post(f"/api/v1/tests/{test_id}/steps", json={"label": "mean", "frames": 4}).raise_for_status()
    mean = f"/api/v1/tests/{test_id}/steps/1/cam1"
    averaged = client.get(f"{mean}/pixels", params={"x_px": 7, "y_px": 9}).json()
    whole = picture(client.get(mean).content)
    assert averaged["values"] == [[int(whole[9, 7])]]
    assert averaged["full_scale"] == 255.0 * averaged["grey_scale"] > 255.0
    live = client.get("/api/v1/cameras/cam2/maps/saturation")
    assert live.status_code == 200
    assert picture(live.content).shape == (144, 160, 4)
    refused = client.get("/api/v1/cameras/cam1/pixel", params={"x_px": 160, "y_px": 0})
    assert refused.status_code == 422
    assert refused.json()["code"] == "invalid_input"
    assert client.get(f"{step}/preview", params={"width_px": 1}).status_code == 422
    assert client.get(f"/api/v1/tests/{test_id}/steps/7/cam1/preview").status_code == 404
