"""The whole job in a browser, as a user does it: rig, calibration, test, region, seeds, measurement, field, files.

Each screen is looked at as it is left, in every size and both colours.

Everything that the page can do is done by mouse and keyboard; the API is only read, to compare. What the page cannot
do is done to the simulated world: a camera's cable is pulled and put back.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import xarray
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from stereorig.core.cameras.camera import Camera
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.results.netcdf import library
from stereorig.server.workflows.service import Service
from tests.support.page_audit import in_every_size
from tests.support.page_bench import Watched
from tests.support.page_editor import Editor
from tests.support.results_page import capture_plate, two_digits_of_u
from tests.support.service_rig import SMALL, true_cameras

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SLOW = 200_000
WIDTH, HEIGHT = 256, 240
# load on the simulated plate in kPa, and the load frame's value in N
STEPS = ((0.0, 0.0), (344.5, 193.9), (689.0, 387.8))
# the paper's plate: radius and thickness in mm, Young's modulus in N/mm^2, Poisson's ratio
RADIUS, THICKNESS, MODULUS, POISSON = 13.385, 0.762, 71.0e3, 0.334


@dataclass
class Made:
    """What the whole way leaves for the tests after it."""

    test_id: str = ""
    calibration_id: str = ""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("job") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def made() -> Made:
    return Made()


@pytest.fixture
def finished(client: httpx.Client, made: Made) -> Made:
    """What the whole way leaves; made over the API where it was not gone."""
    if not made.test_id:
        client.put(f"{API}/sim/scene", json={"scene": "grid"}).raise_for_status()
        made.calibration_id, made.test_id = capture_plate(client, "Pressure test")
        client.put(f"{API}/calibrations/{made.calibration_id}/review", json={"decision": "accepted"}).raise_for_status()
    return made


def go(shown: Page, screen: str, heading: str) -> None:
    """Choose a screen in the bar."""
    shown.get_by_role("navigation", name="Screens").get_by_role("link", name=screen, exact=True).click()
    expect(shown.get_by_role("heading", level=1, name=heading)).to_be_visible()


def put_before_the_cameras(shown: Page, scene: str, load: float) -> None:
    """Choose what the simulated rig sees."""
    go(shown, "Rig", "tiny rig")
    shown.get_by_text("Simulated scene").click()
    shown.get_by_label("Scene", exact=True).select_option(scene)
    shown.get_by_label("Load", exact=True).fill(str(load))
    with shown.expect_response(lambda answer: answer.url.endswith("/sim/scene")) as response:
        shown.get_by_role("button", name="Show the scene").click()
    assert response.value.status == 200


def live_pictures_move(shown: Page) -> None:
    """Wait until both live views show pictures that change: each exposure has its own noise."""
    for cam in ("cam1", "cam2"):
        image = shown.get_by_alt_text(f"Live view of {cam}", exact=True)
        shown.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
        before = image.screenshot()
        for _ in range(100):
            if image.screenshot() != before:
                break
            shown.wait_for_timeout(100)
        else:
            raise AssertionError(f"the live view of {cam} stands still")


def capture(shown: Page, label: str, load_n: float) -> Locator:
    """Capture a step; returns the figures that are shown of it."""
    group = shown.get_by_role("group", name="Capture")
    group.get_by_label("Label").fill(label)
    group.get_by_label("Load").fill(str(load_n))
    group.get_by_role("button", name="Capture").click()
    quality = shown.locator('[data-role="quality"]')
    expect(quality).to_contain_text(label, timeout=SLOW)
    return quality


def open_test(shown: Page, part: str = "Capture") -> None:
    """Go back to the test's part: the path leads to the one last open, in a fresh browser to the list."""
    shown.get_by_role("navigation", name="Screens").get_by_role("link", name="Test", exact=True).click()
    listed = shown.get_by_role("link", name="Pressure test").first
    heading = shown.get_by_role("heading", level=1, name="Pressure test")
    expect(listed.or_(heading).first).to_be_visible()
    if listed.is_visible():
        listed.click()
    expect(heading).to_be_visible()
    go(shown, part, "Pressure test")


def deflection_mm(x: Any, y: Any, pressure_kpa: float) -> Any:
    """W of a clamped circular plate under pressure, by the textbook; towards the cameras, so negative."""
    stiffness = MODULUS * THICKNESS**3 / (12 * (1 - POISSON**2))
    share = np.clip(1 - (np.hypot(x, y) / RADIUS) ** 2, 0, None)
    return -pressure_kpa * 1e-3 * RADIUS**4 / (64 * stiffness) * share**2


def grey_of(picture: bytes) -> int:
    return int(np.asarray(Image.open(io.BytesIO(picture)).convert("L"))[0, 0])


@pytest.mark.deep  # the tutorial goes most of this way in the normal tier
def test_from_the_rig_to_the_report(page: Watched, client: httpx.Client, made: Made) -> None:
    shown = page.open()
    audit = in_every_size(shown)
    go(shown, "Results", "Results")
    expect(shown.get_by_role("link", name="Make a test")).to_have_attribute("href", "#/test")  # nothing is there yet
    go(shown, "Rig", "tiny rig")
    live_pictures_move(shown)
    audit("1 rig")
    put_before_the_cameras(shown, "grid", 0)

    # calibrate by the rig file's plan, and accept
    go(shown, "Calibrate", "Calibrate")
    expect(shown.get_by_label("Fitted positions")).to_have_value("0, 5")
    shown.get_by_label("Frames averaged").fill("4")
    shown.get_by_label("Label", exact=True).first.fill("before the test")
    shown.get_by_role("button", name="Calibrate", exact=True).click()
    expect(shown.get_by_label("Progress of the calibration")).to_be_visible()
    verdict = shown.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text("before the test", timeout=SLOW)
    expect(verdict).to_contain_text("is within 0.1 px")
    verdict.get_by_role("button", name="Accept").click()
    expect(verdict).to_contain_text("accepted")
    made.calibration_id = client.get(f"{API}/calibrations").json()["calibrations"][-1]["id"]
    expect(verdict).to_contain_text(made.calibration_id)
    audit("2 calibration")

    # a test with the accepted calibration, and the operator's metadata
    put_before_the_cameras(shown, "plate", STEPS[0][0])
    go(shown, "Test", "Tests")
    expect(shown.get_by_label("Calibration", exact=True)).to_have_value(made.calibration_id)
    audit("3 new test")
    shown.get_by_label("Name").fill("Pressure test")
    shown.get_by_label("Specimen").fill("aluminium plate 7")
    shown.keyboard.press("Tab")  # to the calibration, the notes, the button
    shown.keyboard.press("Tab")
    shown.keyboard.press("Tab")
    shown.keyboard.press("Enter")
    expect(shown.get_by_role("heading", level=1, name="Pressure test")).to_be_visible()
    made.test_id = shown.url.split("/")[-1].removesuffix("?at=capture")
    go(shown, "Test", "Pressure test")
    shown.get_by_text("Metadata for the report").click()
    shown.get_by_label("Operator").fill("A. Smith")
    shown.get_by_role("button", name="Save the metadata").click()
    expect(shown.get_by_text("The metadata are saved.")).to_be_visible()

    # three steps, each with its load
    for n, (pressure, load) in enumerate(STEPS):
        if n:
            put_before_the_cameras(shown, "plate", pressure)
            open_test(shown)
        quality = capture(shown, f"{pressure:g} kPa", load)
        expect(quality).to_contain_text(f"Step {n}")
        expect(shown.locator(f'[data-step="{n}"]')).to_contain_text(f"{pressure:g} kPa")
    steps = client.get(f"{API}/tests/{made.test_id}").json()["steps"]
    assert [(one["label"], one["load_n"]) for one in steps] == [(f"{p:g} kPa", load) for p, load in STEPS]

    # a region, and three points in both views
    go(shown, "Region", "Pressure test")
    first, second = Editor(shown), Editor(shown, 2)
    true = true_cameras(SMALL)
    one, two = (Camera.from_paper(**true[cam]) for cam in ("cam1", "cam2"))
    positions = np.array([[-2.4, -1.8, 0.0], [2.1, -1.5, 0.0], [0.3, 2.2, 0.0]])
    first.drag((60, 60), (180, 170))
    first.tool("Seed")
    for k, (a, b) in enumerate(zip(one.project(positions).xy, two.project(positions).xy, strict=True)):
        first.click(*a)
        expect(shown.locator('[data-role="epipolar"]')).to_have_count(k + 1)
        second.click(*b)
        expect(shown.get_by_text("from its epipolar line")).to_have_count(k + 1)
        shown.wait_for_timeout(350)  # two clicks, not a double one
    shown.get_by_label("Subset", exact=True).fill("25")
    shown.get_by_label("Spacing", exact=True).fill("5")
    expect(shown.locator('[data-role="texture"]')).to_contain_text("subsets")
    audit("4 test with a region")
    shown.get_by_role("button", name="Measure", exact=True).click()
    progress = shown.locator('[data-role="progress"]')
    expect(progress.get_by_label("Progress of the analysis")).to_be_visible()
    expect(shown.locator("#bar-job")).to_contain_text("analysis")
    expect(progress.locator(".badge")).to_have_text("succeeded", timeout=SLOW)
    progress.get_by_role("link", name="Show results").click()

    check_field(shown, client, made.test_id)
    check_gauges(shown)
    export_opens(shown, client, made.test_id)
    audit("5 results and export")
    check_report(shown)
    go(shown, "Results", "Results")
    expect(shown.get_by_role("heading", level=2, name="Pressure test")).to_be_visible()
    audit("7 list of results")

    go(shown, "Jobs & system", "Jobs and system")
    for kind in ("calibration", "analysis"):
        row = shown.locator("tr", has_text=kind).first
        expect(row).to_contain_text("succeeded")
        # how long it took, in the units that people use
        expect(row.locator("td").nth(4)).to_have_text(
            re.compile(r"^(\d(\.\d)?|\d\d)\u00a0s$|^\d+\u00a0min( \d+\u00a0s)?$")
        )
    audit("8 jobs")
    page.sound_beside_captures()


def check_field(shown: Page, client: httpx.Client, test_id: str) -> None:
    """Under the mouse, at zoom, are the right pixel, the field's value there, and the image's grey level."""
    analysis = client.get(f"{API}/tests/{test_id}").json()["analyses"][-1]["id"]
    canvas = shown.locator('canvas[data-role="map"][data-shown="2 w_mm reference"]')
    expect(canvas).to_be_attached()

    def read(frame: str, names: tuple[str, ...]) -> dict[str, Any]:
        of = f"{API}/tests/{test_id}/analyses/{analysis}/steps/2/fields"
        return {
            name: np.array(client.get(f"{of}/{name}", params={"frame": frame}).json()["values"], dtype=float)
            for name in names
        }

    fields = read("specimen", ("x_px", "y_px", "w_mm", "sigma_w_mm", "status"))
    system = read("system", ("x_mm", "y_mm", "w_mm"))
    assert np.isin(fields["status"], (0, 10)).mean() > 0.95
    stored = client.get(f"{API}/tests/{test_id}/steps/0/cam1", params={"format": "png"}).content
    image = np.asarray(Image.open(io.BytesIO(stored)))
    frame = shown.locator(".view .frame").first
    readout = shown.locator(".view .readout").first
    frame.scroll_into_view_if_needed()
    spot = (131.2, 104.7)  # where the mouse is to be, px
    shown.get_by_label("Opacity", exact=True).fill("0")
    for turns in (0, 4, 8):  # of the wheel, over that position
        for _ in range(turns):
            shown.mouse.move(*on_screen(canvas, *spot))
            shown.mouse.wheel(0, -250)
        x, y = on_screen(canvas, *spot)
        shown.mouse.move(x + 1, y)
        shown.mouse.move(x, y)
        distance = np.hypot(fields["x_px"] - spot[0], fields["y_px"] - spot[1])
        r, c = np.unravel_index(np.argmin(distance), distance.shape)
        expect(readout).to_have_attribute("data-value", repr(float(fields["w_mm"][r, c])))
        expect(readout).to_have_attribute("data-column", "131")
        expect(readout).to_have_attribute("data-row", "105")
        expect(readout).to_contain_text(two_digits_of_u(float(fields["w_mm"][r, c]), float(fields["sigma_w_mm"][r, c])))
    # large as it is now, a pixel of the image is many of the screen: its middle has its grey level, but for the JPEG
    for column, row in ((131, 105), (132, 105), (131, 103)):
        x, y = on_screen(canvas, column, row)
        seen = grey_of(shown.screenshot(clip={"x": int(x), "y": int(y), "width": 1, "height": 1}))
        assert abs(seen - int(image[row, column])) <= 12
    shown.get_by_label("Opacity", exact=True).fill("75")
    # the whole field is the plate's, whose formula speaks of the system's frame: the specimen's origin lies elsewhere
    x, y, w = (system[name] for name in ("x_mm", "y_mm", "w_mm"))
    wrong = 1e3 * (w - deflection_mm(x, y, STEPS[2][0]))
    good = np.isin(fields["status"], (0, 10))
    assert np.abs(w[good]).max() > 0.05
    assert np.sqrt(np.mean(wrong[good] ** 2)) < 2.0  # um


def check_gauges(shown: Page) -> None:
    """An extensometer, a line and an area are drawn: strain and mean deflection grow with the load."""
    tools = shown.get_by_role("group", name="Tool")
    canvas = shown.locator('canvas[data-role="map"]')
    shown.get_by_role("button", name="Fit", exact=True).first.click()
    for tool, start, end, role in (
        ("Extensometer", (80, 116), (160, 116), "extensometer-chart"),
        ("Line", (70, 100), (170, 100), "line-chart"),
        ("Area", (100, 95), (140, 135), "area"),
    ):
        tools.get_by_role("button", name=tool, exact=True).click()
        canvas.scroll_into_view_if_needed()
        shown.mouse.move(*on_screen(canvas, *start))
        shown.mouse.down()
        shown.mouse.move(*on_screen(canvas, *end), steps=3)
        shown.mouse.up()
        expect(shown.locator(f'[data-role="{role}"]')).to_have_attribute("data-answer", re.compile("value|mean"))
    shown.locator("summary").get_by_text("Extensometers", exact=True).click()
    shown.get_by_label("Against", exact=True).select_option("load")
    answer = json.loads(shown.locator('[data-role="extensometer-chart"]').get_attribute("data-answer") or "null")
    assert answer["x"] == [load for _, load in STEPS]
    none, half, full = (one[0] for one in answer["value"])
    assert none == 0
    assert half == pytest.approx(0.5 * full, abs=3 * (answer["sigma"][2][0] or 0))  # the plate is linear
    assert full > 0  # its face is stretched in the middle
    areas = json.loads(shown.locator('[data-role="area"]').get_attribute("data-answer") or "null")
    assert areas[-1]["mean"] == pytest.approx(2 * areas[-2]["mean"], rel=0.02)
    rows = shown.locator('[data-role="area"] > .scroll > table > tbody > tr')
    expect(rows.first.locator("td").nth(2)).to_have_text("0")  # the reference
    expect(rows.last.locator("td").nth(2)).to_contain_text("mm")
    tools.get_by_role("button", name="Probe", exact=True).click()


def on_screen(canvas: Locator, x: float, y: float) -> tuple[float, float]:
    """Where a pixel lies in the window, by the transform that the browser drew it with."""
    box = canvas.evaluate("c => { const b = c.getBoundingClientRect(); return [b.left, b.top, b.width, b.height] }")
    return box[0] + (x + 0.5) / WIDTH * box[2], box[1] + (y + 0.5) / HEIGHT * box[3]


def export_opens(shown: Page, client: httpx.Client, test_id: str) -> None:
    """NetCDF and CSV as they are saved by the page hold the field that the page shows."""
    analysis = client.get(f"{API}/tests/{test_id}").json()["analyses"][-1]["id"]
    shown_w = client.get(f"{API}/tests/{test_id}/analyses/{analysis}/steps/2/fields/w_mm?frame=specimen").json()
    w = np.array(shown_w["values"], float)
    shown.get_by_role("button", name="Export", exact=True).click()
    files = {}
    for form in ("nc", "csv"):
        shown.get_by_label("Form", exact=True).select_option(form)
        with shown.expect_download(timeout=SLOW) as saved:
            shown.get_by_role("button", name="Save the file").click()
        assert saved.value.suggested_filename.endswith(f".{form}")
        files[form] = Path(saved.value.path())
    with library, xarray.open_dataset(files["nc"], engine="netcdf4") as opened:
        assert opened["w_mm"].attrs["units"] == "mm"
        np.testing.assert_allclose(opened["w_mm"].values, w, atol=1e-12)
    text = files["csv"].read_text(encoding="utf-8-sig")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    assert len(rows) == w.size
    column = next(name for name in rows[0] if name.startswith("w_mm"))
    np.testing.assert_allclose([float(row[column]) for row in rows], w.ravel(), rtol=1e-6)


def check_report(shown: Page) -> None:
    """The report opens in a window of its own, whole, and states what was measured, how, and what is missing."""
    with shown.context.expect_page(timeout=SLOW) as opened:
        shown.get_by_role("link", name="Open the report").click()
    report = opened.value
    report.wait_for_load_state()
    body = report.locator("body")
    words = " ".join(body.inner_text().split())
    wanted = (
        "Pressure test Report of a displacement measurement",
        "aluminium plate 7",
        "A. Smith",
        "689 kPa 387.8",
        "Stereo angle",
        "E1",
        "Subset size 25 px",
        "Step size 5 px",
        "Strain formulation Green-Lagrange",
        "Calibration good",
        "simulated rig",
        "Laboratory laboratory, in Metadata",
    )
    assert [text for text in wanted if text not in words] == [], words
    assert report.locator("img").count() + report.locator("svg").count() > 2
    for image in report.locator("img").all():
        assert image.evaluate("image => image.complete && image.naturalWidth > 0")
    in_every_size(report)("6 report")
    # the steps' table is as wide as the page, on a screen as on paper
    assert report.locator(".wide:has(#steps-table)").evaluate("table => table.scrollWidth - table.clientWidth") <= 0
    report.close()


def test_a_calibration_that_is_refused(page: Watched, client: httpx.Client, finished: Made) -> None:
    shown = page.open()
    put_before_the_cameras(shown, "grid", 0)
    go(shown, "Calibrate", "Calibrate")
    shown.get_by_label("Fitted positions").fill("0, 0.05")
    shown.get_by_label("Held-out positions").fill("0.02")
    shown.get_by_label("Frames averaged").fill("1")
    expected = shown.locator('[data-role="expected"]')
    expect(expected).to_contain_text("Such views would be refused", timeout=SLOW)
    expect(expected).to_contain_text("allowed are 3 px")
    shown.get_by_role("button", name="Calibrate", exact=True).click()  # all the same
    progress = shown.locator('[data-role="progress"]')
    expect(progress.locator(".problem")).to_be_visible(timeout=SLOW)
    refused = client.get(f"{API}/calibrations").json()["calibrations"][-1]
    assert refused["state"] == "failed"
    problem = client.get(f"{API}/calibrations/{refused['id']}").json()["problem"]
    for part in ("detail", "remedy", "code"):
        expect(progress).to_contain_text(problem[part])
    expect(shown.locator("tr", has_text=refused["id"])).to_contain_text("failed")
    # it cannot be accepted, and no test can be made with it
    panel = shown.locator("section.panel", has=shown.get_by_role("heading", name=refused["id"]))
    expect(panel).to_contain_text(problem["detail"])
    expect(panel.get_by_role("button", name="Accept")).to_have_count(0)
    page.open("#/test")
    choice = shown.get_by_label("Calibration", exact=True)
    expect(choice).to_have_value(finished.calibration_id)
    assert refused["id"] not in [option.get_attribute("value") for option in choice.locator("option").all()]
    page.sound_beside_captures()


def test_a_camera_lost_in_mid_run(page: Watched, client: httpx.Client, service: Service, finished: Made) -> None:
    shown = page.open()
    put_before_the_cameras(shown, "plate", STEPS[0][0])
    open_test(shown)
    group = shown.get_by_role("group", name="Capture")
    group.get_by_label("Label").fill("in a row")
    group.get_by_text("A burst").click()
    group.get_by_label("Steps").fill("2000")
    group.get_by_role("button", name="Capture").click()
    expect(group.get_by_label("Progress of the burst")).to_be_visible()
    expect(shown.locator('[data-step="4"]')).to_be_attached(timeout=SLOW)
    cable = service.rig.pair.units["cam2"].grabber.faults  # type: ignore[attr-defined]
    cable.gone = True
    try:
        problem = group.locator(".problem")
        expect(problem).to_contain_text("cam2", timeout=SLOW)
        expect(problem).to_contain_text("camera_lost")
        job = client.get(f"{API}/jobs", params={"limit": 1}).json()["jobs"][0]
        expect(problem).to_contain_text(job["problem"]["remedy"])
        # the rig's screen states it as well, and continues by itself once the camera is there again
        go(shown, "Rig", "tiny rig")
        box = shown.get_by_role("region", name="cam2", exact=True)
        for part in ("detail", "remedy", "code"):
            fault = client.get(f"{API}/rig").json()["cameras"]["cam2"]["fault"]
            expect(box.get_by_role("alert")).to_contain_text(fault[part])
        expect(shown.get_by_text("without cam2", exact=True)).to_be_visible()
    finally:
        cable.gone = False
    live_pictures_move(shown)
    expect(shown.get_by_text("without cam2", exact=True)).to_have_count(0)
    expect(shown.locator(".problem")).to_have_count(0)
    # what landed before is whole, and the next step has the next number
    open_test(shown)
    steps = client.get(f"{API}/tests/{finished.test_id}").json()["steps"]
    assert [one["n"] for one in steps] == list(range(len(steps)))
    quality = capture(shown, "after it", 0.0)
    expect(quality).to_contain_text(f"Step {len(steps)}: after it")
    for cam in ("cam1", "cam2"):
        path = f"{API}/tests/{finished.test_id}/steps/{len(steps)}/{cam}"
        stored = client.get(path, params={"format": "png"}).content
        assert Image.open(io.BytesIO(stored)).size == (WIDTH, HEIGHT)
    page.sound_beside_captures(503)


def test_a_job_that_is_cancelled(page: Watched, client: httpx.Client, finished: Made) -> None:
    shown = page.open("#/test")
    open_test(shown, "Region")
    Editor(shown).drag((40, 40), (210, 200))
    shown.get_by_label("Subset", exact=True).fill("31")
    shown.get_by_label("Spacing", exact=True).fill("1")
    shown.get_by_role("textbox", name="Steps", exact=True).fill("0-2")
    shown.get_by_label("Label", exact=True).last.fill("too fine")
    shown.get_by_role("button", name="Measure", exact=True).click()
    progress = shown.locator('[data-role="progress"]')
    expect(shown.locator("#bar-job")).to_contain_text("analysis", timeout=SLOW)
    progress.get_by_role("button", name="Cancel").click()
    expect(progress.locator(".badge")).to_have_text("cancelled", timeout=SLOW)
    go(shown, "Jobs & system", "Jobs and system")
    row = shown.locator("tbody tr").first
    expect(row).to_contain_text("analysis")
    expect(row).to_contain_text("cancelled")
    expect(row.get_by_role("button", name="Cancel")).to_have_count(0)
    # and what was cancelled is among the results as what it is
    go(shown, "Results", "Results")
    shown.get_by_role("link", name="too fine").click()
    expect(shown.get_by_text("cancelled", exact=True).first).to_be_visible()
    page.sound_beside_captures()
