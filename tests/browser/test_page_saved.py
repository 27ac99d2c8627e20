"""What the page saves as files is what is seen: deformed images, the surface in space, a calibration's views."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.support import results_page
from tests.support.page_bench import Watched
from tests.support.results_page import API, Bench, shown
from tests.support.service_rig import wait_for_job

bench, page = results_page.bench, results_page.page  # fixtures

pytestmark = pytest.mark.timeout(600)

LIMITS = re.compile(r"from ([\d.-]+) to ([\d.-]+) mm")
EDGE = 12  # px, white about the picture's frame
TOP = {False: 40, True: 62}  # px, where the frame begins; with a name above it


def saved(at: Page, press: Locator) -> Path:
    with at.expect_download() as file:
        press.click()
    return Path(file.value.path())


def drawn_in(at: Page, picture: Locator) -> np.ndarray:
    """Return the pixels of a picture on the page, in its own size."""
    read = """image => { const copy = document.createElement('canvas');
        [copy.width, copy.height] = [image.naturalWidth, image.naturalHeight];
        copy.getContext('2d').drawImage(image, 0, 0);
        return copy.toDataURL('image/png').split(',')[1] }"""
    return pixels(base64.b64decode(at.evaluate(read, picture.element_handle())))


def pixels(data: bytes | Path) -> np.ndarray:
    with Image.open(data if isinstance(data, Path) else io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def difference(at: Page, seen: Locator, picture: np.ndarray, *, named: bool, times: int = 1) -> tuple[float, float]:
    """Return the mean difference, grey levels, of what is seen and the same place of a picture; and of it mirrored."""
    at.mouse.move(2, 2)
    # a saved picture has the colour bar below
    looked = Image.open(io.BytesIO(seen.screenshot(style=".stage > .colourbar { visibility: hidden }"))).convert("RGB")
    wide = picture.shape[1] // times - 2 * EDGE
    high = round(wide * looked.height / looked.width)
    expected = np.asarray(looked.resize((times * wide, times * high), Image.Resampling.BILINEAR)).astype(float)
    top = times * TOP[named]
    found = picture[top : top + times * high, times * EDGE : times * (EDGE + wide)]
    expected = expected[: found.shape[0]]
    return float(np.abs(found - expected).mean()), float(np.abs(found[:, ::-1] - expected).mean())


def bar_below(at: Page, picture: np.ndarray, times: int = 1) -> None:
    """Assert that the colour bar's own colours stand in one row below the frame, from the left to the right."""
    colours = at.evaluate(
        "() => { const bar = document.querySelector('.colourbar canvas');"
        " return [...bar.getContext('2d').getImageData(0, 0, bar.width, 1).data] }"
    )
    bar = np.array(colours, dtype=float).reshape(-1, 4)[:, :3]
    wide = picture.shape[1] - 2 * times * (EDGE + 30)
    samples = [0.1, 0.5, 0.9]
    columns = [int(times * (EDGE + 30) + share * wide) for share in samples]
    wanted = np.array([bar[int(share * len(bar))] for share in samples])
    rows = np.abs(picture[:, columns] - wanted).max(axis=(1, 2)) <= 6
    assert times * 8 < rows.sum() < times * 20, "no row has the bar's colours"


def test_a_deformed_picture_is_saved_as_it_is_seen_with_its_bar(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Export", exact=True).click()
    at.get_by_label("Image", exact=True).select_option("cam2")
    at.wait_for_selector('canvas[data-role="map"][data-shown="2 w_mm cam2"]', state="attached")
    at.get_by_label("contour lines, about").check()
    expect(at.locator(".overlay[data-lines]")).not_to_have_attribute("data-lines", "0")
    expect(at.locator('[data-role="seen"]')).to_contain_text("its lines and its image included")
    picture = pixels(saved(at, at.get_by_role("button", name="Save as PNG").last))
    assert picture.shape[1] == 1200
    content = at.locator(".view .content").first
    own, mirrored = difference(at, content, picture, named=False)
    assert own < 0.4 * mirrored, (own, mirrored)
    assert own < 0.1 * 255  # speckles at another size, and a pixel at the edges
    bar_below(at, picture)
    drawing = saved(at, at.get_by_role("button", name="Save as SVG").last).read_text()
    for words in ("over the image: this step, camera 2", bench.analysis_id, "689.0 kPa", 'data-role="bar"'):
        assert words in drawing, words
    assert "var(--" not in drawing  # another program has no style sheet of the page
    page.sound()


def test_the_surface_is_saved_with_its_axes_and_its_bar(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="3-D surface").click()
    space = at.locator(".space")
    expect(space).to_have_attribute("data-drawn", "2 w_mm")
    at.wait_for_timeout(500)
    picture = pixels(saved(at, at.get_by_role("button", name="Save picture")))
    assert picture.shape[1] == 2400
    own, mirrored = difference(at, space, picture, named=True, times=2)
    assert own < 0.4 * mirrored, (own, mirrored)
    bar_below(at, picture, times=2)
    at.get_by_role("button", name="Export", exact=True).click()
    expect(at.locator('[data-role="seen"]')).to_contain_text("as it is seen, in space")
    drawing = saved(at, at.get_by_role("button", name="Save as SVG").last).read_text()
    unit = at.locator('[data-role="colourbar"] .of').inner_text()
    for words in ("X (mm)", "Y (mm)", "displacement ×", "the surface in space", f">{unit}<"):
        assert words in drawing, words
    page.sound()


def test_both_views_are_saved_side_by_side_and_their_difference_with_a_bar_of_its_own(
    page: Watched, bench: Bench
) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Export", exact=True).click()
    at.get_by_role("button", name="Side by side").click()
    expect(at.locator('canvas[data-role="map-other"]')).to_have_attribute("data-shown", "2 w_mm reference")
    expect(at.locator('[data-role="seen"]')).to_contain_text("both views side by side")
    picture = pixels(saved(at, at.locator('[data-role="save-png"]')))
    each = (picture.shape[1] - 3 * EDGE) // 2
    top = TOP[True]
    at.mouse.move(2, 2)
    for k, left in enumerate((EDGE, 2 * EDGE + each)):
        looked = Image.open(io.BytesIO(at.locator(".view .content").nth(k).screenshot())).convert("RGB")
        high = round(each * looked.height / looked.width)
        expected = np.asarray(looked.resize((each, high), Image.Resampling.BILINEAR)).astype(float)
        found = picture[top : top + high, left : left + each]
        own = np.abs(found - expected[: found.shape[0], : found.shape[1]]).mean()
        assert own < 0.4 * np.abs(found[:, ::-1] - expected[: found.shape[0], : found.shape[1]]).mean()
    svg = at.get_by_role("button", name="Save as SVG").last
    drawing = saved(at, svg).read_text()
    assert (drawing.count('data-role="seen"'), drawing.count('data-role="bar"')) == (2, 1)
    assert "with a cut, step 2" in drawing
    at.get_by_label("Right view").select_option("difference")
    expect(at.locator('[data-role="difference-panel"]')).to_be_visible()
    expect(at.locator('[data-role="difference"]')).to_have_attribute("data-count", re.compile(r"\d"))
    drawing = saved(at, svg).read_text()
    assert (drawing.count('data-role="seen"'), drawing.count('data-role="bar"')) == (2, 2)
    assert "This less with a cut, step 2" in drawing
    page.sound()


def test_a_calibrations_plots_are_saved_as_numbers_and_pictures(page: Watched, bench: Bench) -> None:
    at = page.open("#/calibrate")
    expect(at.get_by_role("region", name="Views")).to_be_visible()
    at.wait_for_function("() => [...document.querySelectorAll('.views .view img')].every(one => one.naturalWidth > 0)")
    calibration = bench.client.get(f"{API}/calibrations").json()["calibrations"][-1]["id"]
    views = at.get_by_role("group", name="Save these views")
    head, *lines = saved(at, views.get_by_role("button", name="Save as CSV")).read_text().splitlines()
    assert head == "camera,view,row,column,x (px),y (px),residual x (px),residual y (px)"
    known = bench.client.get(f"{API}/calibrations/{calibration}/residuals").json()
    residuals = {one["name"]: one for one in (known if isinstance(known, list) else known["views"])}
    seen = set()
    for camera, name, row, column, *numbers in (line.split(",") for line in lines):
        seen.add(camera)
        one = residuals[name]
        wanted = [*one["found_px"][int(row)][int(column)], *one["residual_px"][int(row)][int(column)]]
        assert [float(text) if text else None for text in numbers] == wanted
    assert seen == {"cam1", "cam2"}
    drawing = saved(at, views.get_by_role("button", name="Save as SVG")).read_text()
    for words in ('data-role="nodes"', 'data-role="arrows"', ">cam1<", "residual arrows", "data:image/png"):
        assert words in drawing, words
    assert "var(--" not in drawing
    picture = pixels(saved(at, views.get_by_role("button", name="Save as PNG")))
    yellow = (picture[..., 0] > 200) & (picture[..., 1] > 170) & (picture[..., 2] < 120)
    assert yellow[:, : yellow.shape[1] // 2].sum() > 100  # intersections of camera 1
    assert yellow[:, yellow.shape[1] // 2 :].sum() > 100
    at.get_by_text("Correlation of the parameters").click()
    group = at.get_by_role("group", name="Save the correlations")
    table = saved(at, group.get_by_role("button", name="Save as CSV")).read_text().splitlines()
    covariance = bench.client.get(f"{API}/calibrations/{calibration}").json()["covariance"]
    matrix = np.array(covariance["matrix"])
    sigma = np.sqrt(np.diag(matrix))
    assert table[0].split(",")[1:] == covariance["names"]
    found = np.array([[float(v) for v in line.split(",")[1:]] for line in table[1:]])
    np.testing.assert_allclose(found, matrix / np.outer(sigma, sigma), rtol=1e-12)
    drawing = saved(at, group.get_by_role("button", name="Save as SVG")).read_text()
    assert len(re.findall("fill-opacity", drawing)) == matrix.size
    page.sound()


def test_a_dense_field_is_seen_and_saved_where_one_was_measured(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Export", exact=True).click()
    expect(at.get_by_label("the dense field")).to_have_count(0)  # none was asked for
    path = f"{API}/tests/{bench.test_id}/analyses"
    asked = {"region": {"rectangle": [70, 70, 150, 150]}, "subset_px": 25, "spacing_px": 10, "dense_step_px": 4}
    made = bench.client.post(path, json={**asked, "steps": [0, 2]}).json()
    assert wait_for_job(bench.client, made["job"])["state"] == "succeeded"
    analysis_id = made["analysis_id"]
    at = shown(page, bench, analysis_id=analysis_id)
    at.get_by_text("Settings and checks").click()
    (figures,) = [one for one in bench.client.get(f"{path}/{analysis_id}").json()["summary"]["steps"] if one["n"] == 2]
    assert figures["dense"]["valid"] > 200
    row = at.locator('[data-role="about"] tbody tr').nth(1)
    expect(row).to_contain_text(f"{figures['dense']['valid']} of {figures['dense']['vectors']}")
    at.get_by_role("button", name="Export", exact=True).click()
    at.get_by_label("the dense field").check()
    expect(at.locator('[data-role="seen"]')).to_contain_text("its dense field, a vector every 4 px")
    picture = at.locator('[data-role="dense-map"] img')
    at.wait_for_function("image => image.naturalWidth === 900", arg=picture.element_handle())
    # the service's own map between the same limits, which the page rounds; the ordinary field's is another one
    seen = drawn_in(at, picture)
    low, high = (
        float(text)
        for text in LIMITS.findall(at.locator('[data-role="seen"]').inner_text().replace("\N{MINUS SIGN}", "-"))[0]
    )
    options = {"format": "png", "step": 2, "variables": "w_mm", "frame": "specimen", "over_image": "true"}
    options |= {"limits": f"{low},{high}", "opacity": "0.75"}
    dense, ordinary = (
        pixels(bench.client.get(f"{path}/{analysis_id}/export", params={**options, "dense": which}).content)
        for which in ("true", "false")
    )
    assert 3.0 * np.abs(seen - dense).mean() < np.abs(seen - ordinary).mean()  # neither field is biased: they are near
    # the numbers
    at.get_by_label("Points", exact=True).select_option("dense")
    at.get_by_label("Form", exact=True).select_option("csv")
    table = pd.read_csv(saved(at, at.get_by_role("button", name="Save the file")))
    assert json.loads(table.about[0])["method"].startswith("dense, shared windows")
    assert len(table) == figures["dense"]["vectors"]
    # strain is the ordinary field's alone: said where the map would be
    at.get_by_label("Field", exact=True).select_option("exx")
    expect(at.locator('[data-role="dense-map"] .problem')).to_contain_text("exx")
    page.sound(404)
