"""The page's tests in a browser: make one, capture, import, draw, click seeds, measure."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Locator, expect

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.settings import (
    DEFAULT_MAX_SIGMA_PX,
    DENSE_STEP_PX,
    SMOOTHING_WINDOW,
    SPACING_PX,
    STRAIN_WINDOW,
    SUBSET_PX,
)
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.page_bench import Watched
from tests.support.page_editor import HEIGHT, WIDTH, Editor, asked
from tests.support.service_rig import SMALL, new_test, true_cameras, wait_for_job

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SLOW = 300_000
# width of a drawing on the screen; its bounding box would count the stroke
ON_SCREEN = "path => path.getBBox().width * path.getScreenCTM().a"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("page") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def cameras() -> dict[str, dict[str, float]]:
    return true_cameras(SMALL)


@pytest.fixture(scope="module")
def calibration(client: httpx.Client, cameras: dict[str, dict[str, float]]) -> str:
    sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))})
    assert sent.status_code == 201, sent.text
    return str(sent.json()["id"])


@pytest.fixture(scope="module")
def plate(client: httpx.Client, calibration: str) -> str:
    """A test with two steps of the plate."""
    test_id = new_test(client, name="plate", calibration_id=calibration)
    for load in (0.0, 344.5):
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": load}).raise_for_status()
        client.post(f"{API}/tests/{test_id}/steps", json={"label": f"{load} kPa"}).raise_for_status()
    return test_id


def test_make_tell_capture(page: Watched, client: httpx.Client, calibration: str) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()
    shown = page.open("#/test")
    shown.get_by_role("button", name="Make the test").click()
    beside = shown.locator(".field", has=shown.get_by_label("Name", exact=True))
    expect(beside.get_by_role("alert")).to_contain_text("The test has no name.")
    expect(shown.get_by_label("Name", exact=True)).to_be_focused()
    shown.get_by_label("Name").fill("Plate <b> & more")
    shown.get_by_label("Specimen").fill("aluminium")
    shown.get_by_label("Calibration", exact=True).select_option(calibration)
    shown.get_by_role("button", name="Make the test").click()
    expect(shown.get_by_role("heading", name="Plate <b> & more")).to_be_visible()
    test_id = page.page.url.split("/")[-1].removesuffix("?at=capture")
    screens = shown.get_by_role("navigation", name="Screens")
    # metadata for the report
    screens.get_by_role("link", name="Test", exact=True).click()
    shown.get_by_text("Metadata for the report").click()
    shown.get_by_label("Operator").fill("A. Smith")
    camera = shown.get_by_role("group", name="Camera 2 and its lens")
    camera.get_by_label("Focal length").fill("50")
    shown.get_by_role("button", name="Save the metadata").click()
    expect(shown.get_by_text("The metadata are saved.")).to_be_visible()
    assert client.get(f"{API}/tests/{test_id}/metadata").json() == {
        "operator": "A. Smith",
        "cam2": {"lens": {"focal_length_mm": 50.0}},
    }
    screens.get_by_role("link", name="Capture", exact=True).click()
    # a step with the load frame's values, and the quality of the pair
    group = shown.get_by_role("group", name="Capture")
    group.get_by_label("Label").fill("1.25 kN")
    group.get_by_label("Load").fill("1250")
    group.get_by_label("Channels").fill("stroke_mm = 0,42")
    group.get_by_role("button", name="Capture").click()
    channels = group.locator(".field", has=shown.get_by_label("Channels"))
    expect(channels.get_by_role("alert")).to_contain_text("is not a channel")
    group.get_by_label("Channels").fill("stroke_mm = 0.42, temperature_c = -21.3")
    group.get_by_role("button", name="Capture").click()
    quality = shown.locator('[data-role="quality"]')
    expect(quality).to_contain_text("Step 0: 1.25 kN", timeout=SLOW)
    step = client.get(f"{API}/tests/{test_id}/steps/0").json()
    assert step["channels"] == {"stroke_mm": 0.42, "temperature_c": -21.3}
    assert step["load_n"] == 1250.0
    expect(quality).to_contain_text(f"{step['quality']['cam2']['focus']:.3f}"[:4])
    thumbnail = shown.locator('[data-step="0"] img')
    shown.wait_for_function("image => image.naturalWidth === 132", arg=thumbnail.element_handle())
    page.sound_beside_captures()


def test_the_path_leads_back_to_the_test_and_its_parts_and_ticks_what_is_done(page: Watched, plate: str) -> None:
    shown = page.open(f"#/test/{plate}")
    screens = shown.get_by_role("navigation", name="Screens")
    for name, done in (
        ("Rig", True),
        ("Test", True),
        ("Capture", True),
        ("Region", False),
        ("Measure", False),
        ("Results", False),
    ):
        link = screens.get_by_role("link", name=name, exact=True)
        expect(link).to_have_attribute("title", re.compile("^Done" if done else "^Not yet"))
    expect(screens.get_by_role("link", name="Test", exact=True)).to_have_attribute("aria-current", "page")
    # live where one captures
    screens.get_by_role("link", name="Capture", exact=True).click()
    for cam in ("cam1", "cam2"):
        live = shown.get_by_alt_text(f"Live view of {cam}", exact=True)
        shown.wait_for_function("image => image.naturalWidth > 0", arg=live.element_handle())
    # each part is a screen of its own, and what was drawn on it stays
    screens.get_by_role("link", name="Region", exact=True).click()
    Editor(shown).drag((90, 80), (170, 160))
    drawn = shown.get_by_text("Draw a region to rate its speckle quality")
    expect(drawn).to_have_count(0)
    # a region that is drawn is kept, and that is the step's end; nothing was measured yet
    expect(screens.get_by_role("link", name="Region", exact=True)).to_have_attribute("title", re.compile("^Done"))
    expect(screens.get_by_role("link", name="Measure", exact=True)).to_have_attribute("title", re.compile("^Not yet"))
    screens.get_by_role("link", name="Measure", exact=True).click()
    expect(shown.get_by_role("button", name="Measure", exact=True)).to_be_in_viewport()
    expect(drawn).to_have_count(0)
    own = {
        "Test": "Metadata for the report",
        "Capture": "Live view",
        "Region": "Seed",
        "Live": "Measure live",
        "Verify": "Plan the procedure",
    }
    for name in (*own, "Measure"):
        screens.get_by_role("link", name=name, exact=True).click()
        expect(shown.get_by_text("Recipes: kept for the next specimen")).to_be_visible(
            visible=name in ("Region", "Measure")
        )
        expect(shown.get_by_text("This test has not been measured yet.")).to_be_visible(
            visible=name in ("Test", "Measure")
        )
        for other, text in own.items():
            part = shown.get_by_text(text, exact=True).first
            expect(part).to_be_visible() if other == name else expect(part).to_be_hidden()
        for width, height in ((1024, 768), (390, 844), (1440, 900)):
            shown.set_viewport_size({"width": width, "height": height})
            assert shown.evaluate("document.documentElement.scrollWidth") <= width
        # on a screen of usual size all of it is seen at once
        assert shown.evaluate("document.documentElement.scrollHeight") <= height, name
    # the picture has most of the region's screen, and what is set stands beside it with the button always in sight
    screens.get_by_role("link", name="Region", exact=True).click()
    frame = shown.locator(".work .view .frame").first.bounding_box()
    assert frame is not None
    assert frame["width"] * frame["height"] > 0.45 * 1440 * 900
    expect(shown.get_by_role("button", name="Measure", exact=True)).to_be_in_viewport()
    # camera 2 is an inset until a seed is to be set
    two = shown.locator(".work .view .frame").nth(1)
    small = two.bounding_box()
    shown.get_by_role("button", name="Seed", exact=True).click()
    large = two.bounding_box()
    assert small is not None
    assert large is not None
    assert small["width"] < 0.2 * frame["width"]
    assert large["width"] > 2 * small["width"]
    # from elsewhere it is the test that was open, not the list
    screens.get_by_role("link", name="Rig", exact=True).click()
    expect(shown.get_by_role("heading", level=1, name="tiny rig")).to_be_visible()
    screens.get_by_role("link", name="Test", exact=True).click()
    expect(shown.get_by_role("heading", level=1, name="plate")).to_be_visible()
    page.sound()


def test_cameras_off_their_place_are_told_where_one_captures_with_the_way_back(
    page: Watched, client: httpx.Client, calibration: str
) -> None:
    test_id = new_test(client, name="off its place", calibration_id=calibration)
    moved = client.post(f"{API}/stage/moves", json={"dz_mm": {"cam1": 1.0, "cam2": 1.0}}, params={"wait": 30}).json()
    assert moved["job"]["state"] == "succeeded"
    for _ in range(3):
        assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201
    shown = page.open(f"#/test/{test_id}?at=capture")
    # the long badges of neighbouring thumbnails stay apart
    badges = shown.locator('[data-role="thumbnails"] .badge')
    expect(badges).to_have_count(3)
    expect(badges.first).to_have_text("cameras off their calibrated position")
    boxes = [badge.bounding_box() for badge in badges.all()]
    for one, other in itertools.pairwise(boxes):
        assert one
        assert other
        assert one["x"] + one["width"] < other["x"]
    note = shown.locator('[data-role="way-back"]')
    expect(note).to_contain_text("cam1 by 1.000")
    note.get_by_role("button", name="Back to the calibrated position").click()
    expect(note).to_be_empty()
    axes = client.get(f"{API}/stage").json()["axes"]
    assert [axis["position_mm"] for axis in axes] == pytest.approx([axis["zero_mm"] for axis in axes], abs=0.01)
    page.sound()


def test_a_verification_procedure_is_followed_with_ticks(page: Watched, client: httpx.Client) -> None:
    test_id = new_test(client, name="bench")
    shown = page.open(f"#/test/{test_id}?at=verify")
    panel = shown.locator("[data-role=procedure]")
    said = panel.locator("[data-role=procedure-next]")
    plan = {"static_steps": [1], "translations": [{"n": 2, "translation_mm": [0.0, 0.0, 0.4]}], "rotations": [{"n": 3}]}
    panel.locator("textarea").fill("{")
    panel.get_by_role("button", name="Plan the procedure").click()
    expect(panel.locator(".problem")).to_contain_text("no JSON")
    panel.locator("textarea").fill(json.dumps(plan))
    panel.get_by_role("button", name="Plan the procedure").click()
    expect(said).to_contain_text("Step 0")
    for n in (0, 1):
        panel.get_by_role("button", name="Take the step", exact=True).click()
        expect(panel.locator("[aria-label=taken]")).to_have_count(n + 1, timeout=SLOW)
    # this rig's cameras move along axes of their own: the way is a person's
    expect(said).to_contain_text("Step 2: Move the body by X 0, Y 0, Z 0.4 mm")
    for n in (2, 3):
        panel.get_by_role("button", name="It is done: take the step").click()
        expect(panel.locator("[aria-label=taken]")).to_have_count(n + 1, timeout=SLOW)
    expect(said).to_contain_text("All steps are taken.")
    expect(panel.get_by_role("button", name="Make the certificate")).to_be_visible()
    labels = [step["label"] for step in client.get(f"{API}/tests/{test_id}/steps").json()["steps"]]
    assert labels == ["reference", "static", "moved 0 0 0.4 mm", "turned"]
    page.sound_beside_captures()


def test_pairs_are_imported_in_the_order_of_their_names(page: Watched, client: httpx.Client, tmp_path: Path) -> None:
    test_id = new_test(client, name="imported")
    rng = np.random.default_rng(5)
    files: dict[str, list[Path]] = {"left": [], "right": []}
    for n in (10, 2, 1):  # not as they are to come out
        for side, value in (("left", 60), ("right", 120)):
            image = np.clip(rng.normal(value, 12, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
            image[0, 0] = n
            path = tmp_path / f"{side}_{n}.png"
            assert cv2.imwrite(str(path), image)
            files[side].append(path)
    shown = page.open(f"#/test/{test_id}")
    shown.get_by_text("Import existing pairs").click()
    shown.get_by_label("Images of camera 1").set_input_files(files["left"])
    shown.get_by_label("Images of camera 2").set_input_files(files["right"][:2])
    expect(shown.get_by_text("Camera 1 has 3 images, camera 2 has 2.")).to_be_visible()
    shown.get_by_label("Images of camera 2").set_input_files(files["right"])
    shown.get_by_role("button", name="Import", exact=True).click()
    expect(shown.get_by_text("3 of 3 pairs imported as steps.")).to_be_visible(timeout=SLOW)
    assert [s["label"] for s in client.get(f"{API}/tests/{test_id}").json()["steps"]] == ["left_1", "left_2", "left_10"]
    for n, number in enumerate((1, 2, 10)):
        for cam, side in (("cam1", "left"), ("cam2", "right")):
            data = client.get(f"{API}/tests/{test_id}/steps/{n}/{cam}", params={"format": "png"}).content
            got = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(got, cv2.imread(str(tmp_path / f"{side}_{number}.png"), cv2.IMREAD_UNCHANGED))
    # without a calibration the measurement is refused with the cause
    shown.get_by_role("link", name="Region", exact=True).click()
    shown.get_by_role("button", name="Rectangle in the middle").click()
    shown.get_by_role("button", name="Measure", exact=True).click()
    expect(shown.get_by_role("alert").filter(has_text="calibration")).to_be_visible()
    page.sound(409, 422)


def test_a_load_frames_record_gives_the_steps_their_channels_by_time(
    page: Watched, client: httpx.Client, tmp_path: Path
) -> None:
    test_id = new_test(client, name="with a record")
    taken = [
        datetime.fromisoformat(
            client.post(f"{API}/tests/{test_id}/steps", json={"label": f"s{n}"}).json()["captured_utc"]
        )
        for n in (0, 1)
    ]
    later = (taken[1] - taken[0]).total_seconds()
    # the record's force is 2 kN a second of its own clock; step 0 was taken at its 5 s
    rows = [f"{t:.3f},{2 * t:.4f}" for t in np.arange(0.0, 5.0 + later + 2.0, 0.1)]
    record = tmp_path / "machine.csv"
    record.write_text("\n".join(["Time (s),Force (kN)", *rows]), encoding="utf-8")
    shown = page.open(f"#/test/{test_id}")
    panel = shown.locator('[data-role="import-record"]')
    panel.locator("summary").click()
    send = panel.get_by_role("button", name="Import the record")
    send.click()
    beside = panel.locator(".field", has=shown.get_by_label("File of the record")).get_by_role("alert")
    expect(beside).to_have_text("Choose the record's file.")
    # a file that leaves something open is shown with what is read in it, and with a field that answers
    unsure = tmp_path / "unsure.csv"
    unsure.write_text("Probe;P-07\nZeit;Kraft\ns;kN\n0,5;1\n1,5;OVER\n0,5;3\n1,5;4\n", encoding="utf-16")
    panel.get_by_label("File of the record").set_input_files(unsure)
    seen = panel.locator('[data-role="preview"]')
    expect(seen).to_contain_text("left out: 1 line above the table")
    expect(seen.locator(".problem").nth(0)).to_contain_text("2 segments")
    expect(seen.locator(".problem").nth(1)).to_contain_text("'OVER' in line 5")
    expect(seen.get_by_role("row").filter(has_text="kraft_kn")).to_contain_text("kN")
    panel.get_by_label("Part of the record").select_option("2")
    expect(seen.locator(".problem")).to_have_count(1)
    panel.get_by_label("File of the record").set_input_files(record)
    expect(seen).to_contain_text("no line left out")
    expect(panel.get_by_label("Part of the record")).to_have_count(0)
    panel.get_by_label("At step").fill("7")
    panel.get_by_label("Time of the record").fill("5")
    send.click()
    expect(panel.get_by_role("alert")).to_have_text("The test has no step 7.")
    panel.get_by_label("At step").fill("0")
    panel.get_by_label("Channel of the load").fill("force_kn")
    shown.locator('[data-step="1"] button').click()
    send.click()
    said = panel.locator('[data-role="record"]')
    expect(said).to_contain_text("2 of 2 steps have values of force_kn (kN) now")
    step = client.get(f"{API}/tests/{test_id}/steps/1").json()
    assert step["channels"]["force_kn"] == pytest.approx(2 * (5.0 + later), abs=1e-3)
    assert step["load_n"] == pytest.approx(2e3 * (5.0 + later), abs=1.0)
    # what is shown of a step has them at once
    expect(shown.locator('[data-role="quality"]')).to_contain_text("force_kn")
    # the same record with another clock is refused in words, and nothing changes
    panel.get_by_label("Time of the record").fill("6")
    send.click()
    expect(said.locator(".problem")).to_contain_text("force_kn")
    assert client.get(f"{API}/tests/{test_id}/steps/1").json()["channels"] == step["channels"]
    page.sound_beside_captures(422)


@pytest.mark.parametrize("presses", [0, 4])
def test_the_region_that_is_posted_is_the_one_drawn(page: Watched, plate: str, presses: int) -> None:
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown)
    editor.key("+", presses)
    middle = (127.5, 119.5)
    (x0, y0), (x1, y1) = (middle[0] - 31, middle[1] - 24), (middle[0] + 28, middle[1] + 26)
    # to a pixel
    sent = asked(shown, "/texture", lambda: editor.drag((x0, y0), (x1, y1)), "rectangle", [x0, y0, x1, y1], 1.0)
    # a corner by keyboard: whole pixels; and back
    corner = shown.get_by_role("button", name="Corner 1 of the region")
    corner.focus()
    before = sent["region"]["rectangle"]
    moved = [before[0] - 1, before[1] - 10, before[2], before[3]]
    asked(
        shown, "/texture", lambda: (corner.press("ArrowLeft"), corner.press("Shift+ArrowUp")), "rectangle", moved, 1e-6
    )
    undo = shown.get_by_role("button", name="Undo")
    asked(shown, "/texture", lambda: (undo.click(), undo.click()), "rectangle", before, 1e-6)
    # a polygon in its place, a hole, a crack
    corners = [(90, 85), (165, 88), (160, 150), (95, 145)]

    def polygon() -> None:
        editor.tool("Polygon")
        for xy in corners:
            editor.click(*xy)
            shown.wait_for_timeout(350)
        editor.key("Enter")

    asked(shown, "/texture", polygon, "polygon", corners, 1.0)
    hole, crack = [(110, 100), (120, 100), (115, 110)], [(130, 120), (140, 122), (150, 119)]
    for name, points in (("Hole", hole), ("Crack line", crack)):
        editor.tool(name)
        for xy in points:
            editor.click(*xy)
            shown.wait_for_timeout(350)
        editor.key("Enter")
    shown.get_by_label("Subset", exact=True).fill("15")
    shown.get_by_text("Advanced", exact=True).click()
    shown.get_by_label("Dense field, a vector every", exact=True).fill("3")
    shown.get_by_role("textbox", name="Steps", exact=True).fill("0")
    sent = asked(shown, "/analyses", lambda: shown.get_by_role("button", name="Measure", exact=True).click())
    assert np.abs(np.array(sent["region"]["holes"][0]) - hole).max() <= 1.0
    assert np.abs(np.array(sent["region"]["cracks"][0]) - crack).max() <= 1.0
    assert "rectangle" not in sent["region"]
    assert (sent["subset_px"], sent["dense_step_px"]) == (15, 3)
    progress = shown.locator('[data-role="progress"]')
    cancel: Locator = progress.get_by_role("button", name="Cancel")
    cancel.or_(progress.locator(".badge")).first.wait_for(timeout=SLOW)
    if cancel.is_visible():
        cancel.click()
    page.sound(409)  # it may have ended before the cancel came


@pytest.mark.parametrize("camera", [1, 2])
def test_the_grey_level_under_the_mouse_is_the_recorded_one(
    page: Watched, client: httpx.Client, plate: str, camera: int
) -> None:
    data = client.get(f"{API}/tests/{plate}/steps/0/cam{camera}", params={"format": "png"}).content
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown, camera)
    readout = editor.view.locator(".readout")
    frame = editor.view.locator(".frame").bounding_box()
    assert frame is not None
    for key, presses in (("0", 1), ("1", 1), ("+", 10)):
        editor.key(key, presses)
        for dx, dy in ((5.3, 3.2), (-41.3, 28.4)):  # of no zoom on the border of two pixels
            at = (frame["x"] + frame["width"] / 2 + dx, frame["y"] + frame["height"] / 2 + dy)
            box = None
            while box is None or editor.image.bounding_box() != box:  # the page may still move what lies above
                box = editor.image.bounding_box()
                assert box is not None
                column = int((at[0] - box["x"]) / box["width"] * WIDTH)
                row = int((at[1] - box["y"]) / box["height"] * HEIGHT)
                readout.evaluate("one => { one.textContent = '' }")  # what is read next is of this place
                shown.mouse.move(*at)
                expect(readout).to_contain_text(re.compile(r"grey \d+ of 255$"))
            assert f"grey {stored[row, column]} of 255" in (readout.text_content() or "")
            assert readout.get_attribute("data-column") == str(column)
            assert readout.get_attribute("data-row") == str(row)
    page.sound()


def test_subsets_are_drawn_to_scale_and_texture_is_judged(page: Watched, client: httpx.Client, plate: str) -> None:
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown)
    editor.drag((90, 80), (170, 160))
    texture = shown.locator('[data-role="texture"]')
    expect(texture).to_contain_text("texture")
    shown.get_by_label("Subset", exact=True).fill("41")
    body = {"region": {"rectangle": [90, 80, 170, 160]}, "subset_px": 41, "spacing_px": 10}
    rated = client.post(f"{API}/tests/{plate}/steps/0/texture", json=body).json()
    expect(texture).to_contain_text(f"of {rated['subsets']} subsets")
    square = shown.locator('[data-role="subset"]')
    picture = editor.image.bounding_box()
    assert picture is not None
    assert square.evaluate(ON_SCREEN) == pytest.approx(41 / WIDTH * picture["width"], abs=1)
    shown.get_by_label("texture map").check()
    expect(shown.get_by_text("a subset of 41 px")).to_be_visible()
    shown.get_by_role("button", name="Zoom to the subsets").click()
    assert square.evaluate(ON_SCREEN) == pytest.approx(41 * 6, abs=1)
    page.sound()


def test_each_field_of_a_measurement_says_its_error_beside_itself_and_nothing_is_sent(
    page: Watched, plate: str
) -> None:
    shown = page.open(f"#/test/{plate}?at=region")
    sent: list[str] = []
    shown.on("request", lambda one: one.method == "POST" and sent.append(one.url))
    measure = shown.get_by_role("region", name="Region and analysis")

    def beside(label: str) -> Locator:
        return measure.locator(".field", has=shown.get_by_label(label, exact=True)).get_by_role("alert")

    measure.get_by_text("Advanced", exact=True).click()
    # the limits are those of the settings
    expect(measure.get_by_label("Largest sigma of a match", exact=True)).to_have_value(str(DEFAULT_MAX_SIGMA_PX))
    for label, limits in (
        ("Subset", SUBSET_PX),
        ("Spacing", SPACING_PX),
        ("Window", STRAIN_WINDOW),
        ("Smoothing window", SMOOTHING_WINDOW),
        ("Dense field, a vector every", DENSE_STEP_PX),
    ):
        control = measure.get_by_label(label, exact=True)
        kept = [control.get_attribute(name) for name in ("min", "max", "step")]
        assert kept == [str(limits.low), str(limits.high), "2" if limits.odd else "1"]
    for label, text, said in (
        ("Subset", "32", "Give an odd number, 31 or 33, not 32\u00a0px: it has a middle."),
        ("Spacing", "0", "Give 1 to 1000\u00a0px, not 0\u00a0px."),
        ("Window", "", "A window is needed here."),
        ("Smoothing window", "2", "Give 3 to 51\u00a0points, not 2\u00a0points."),
        ("Dense field, a vector every", "30", "Give 1 to 20\u00a0px, not 30\u00a0px."),
        ("Prefilter, sd", "9", "Give a quarter of the subset at most, 8\u00a0px, not 9\u00a0px."),
        ("Largest sigma of a match", "2", "Give 0.001 to 1\u00a0px, not 2\u00a0px."),
        ("Steps", "0-7", "There is no step 2: the test has steps 0 to 1."),
    ):
        measure.get_by_label(label, exact=True).fill(text)
        shown.keyboard.press("Tab")
        expect(beside(label)).to_have_text(said)
    Editor(shown).drag((90, 80), (170, 160))
    expect(measure.locator('[data-role="texture"]')).to_have_text("Correct the fields that are marked.")
    start = measure.get_by_role("button", name="Measure", exact=True)
    start.click()
    expect(measure.get_by_label("Subset", exact=True)).to_be_focused()
    assert sent == []
    # put right, each takes its error back; without strain its window is not asked about
    measure.get_by_label("compute strain").uncheck()
    expect(beside("Window")).to_have_count(0)
    measure.get_by_label("Subset", exact=True).fill("37")
    expect(beside("Subset")).to_have_count(0)
    expect(beside("Prefilter, sd")).to_have_count(0)  # 9 px is a quarter of it
    for label, text in (
        ("Spacing", "10"),
        ("Dense field, a vector every", "12"),
        ("Smoothing window", ""),
        ("Largest sigma of a match", "0.1"),
        ("Steps", ""),
    ):
        measure.get_by_label(label, exact=True).fill(text)
    # no denser than the ordinary field: that hangs on the spacing
    denser = "Give the spacing at most, 10\u00a0px, not 12\u00a0px: it would be no denser."
    expect(beside("Dense field, a vector every")).to_have_text(denser)
    measure.get_by_label("Spacing", exact=True).fill("12")
    expect(measure.get_by_role("alert")).to_have_count(0)
    # a region that is missing is said where it is drawn; what stands beside no field is left behind with its screen
    Editor(shown).key("Control+z")  # the region goes
    expect(measure.locator('[data-role="texture"]')).to_contain_text("Draw a region")
    start.click()
    missing = measure.get_by_role("alert")
    expect(missing).to_contain_text("There is no region.")
    expect(measure.get_by_role("button", name="Find the specimen")).to_be_focused()
    Editor(shown).key("Control+y")
    expect(missing).to_have_count(0)
    shown.evaluate("import('/static/lib/dom.js').then(({ notify }) => { notify(new Error('It is over.')) })")
    notice = shown.locator("#notices .notice.bad")
    expect(notice).to_contain_text("It is over.")
    shown.get_by_role("link", name="Jobs & system", exact=True).click()
    expect(shown.get_by_role("heading", level=1, name="Jobs and system")).to_be_visible()
    expect(notice).to_have_count(0)
    page.sound()


def test_seeds_in_both_views_and_a_measurement(
    page: Watched, client: httpx.Client, plate: str, cameras: dict[str, dict[str, float]]
) -> None:
    pair = StereoPair(*(Camera.from_paper(**cameras[cam]) for cam in ("cam1", "cam2")))
    # points on the plate, by the rig's own cameras
    positions = np.array([[-0.8, -0.5, 0.0], [0.9, -0.4, 0.0], [0.1, 0.9, 0.0]])
    one, two = (camera.project(positions).xy for camera in (pair.cam1, pair.cam2))
    for job in client.get(f"{API}/jobs").json()["jobs"]:
        wait_for_job(client, job)  # an analysis of another test that still ran would be shown beside this one
    shown = page.open(f"#/test/{plate}?at=region")
    first, second = Editor(shown), Editor(shown, 2)
    x, y = one.mean(axis=0)
    first.drag((x - 45, y - 40), (x + 45, y + 40))
    first.tool("Seed")
    for a, b in zip(one, two, strict=True):
        asked(shown, "/seeds:check", lambda a=a: first.click(*a))
        shown.wait_for_selector('[data-role="epipolar"]', state="attached")
        asked(shown, "/seeds:check", lambda b=b: second.click(*b))
        shown.wait_for_timeout(350)
    off = shown.get_by_text("from its epipolar line")
    expect(off).to_have_count(3)
    for text in off.all_inner_texts():
        assert float(re.search(r"is ([\d.]+) px", text)[1]) < 2.0  # type: ignore[index]
    shown.get_by_label("Subset", exact=True).fill("25")
    shown.get_by_label("Label", exact=True).last.fill("seeded")
    button = shown.get_by_role("button", name="Measure", exact=True)
    sent = asked(shown, "/analyses", button.click)
    assert np.abs(np.array(sent["seeds"]) - one).max() <= 1.0
    assert np.abs(np.array(sent["seeds_cam2"]) - two).max() <= 1.0
    progress = shown.locator('[data-role="progress"]')
    expect(progress.locator(".badge")).to_have_text("succeeded", timeout=SLOW)
    analysis = client.get(f"{API}/tests/{plate}").json()["analyses"][-1]
    assert progress.get_by_role("link", name="Show results").get_attribute("href") == (
        f"#/results/{plate}/{analysis['id']}"
    )
    shown.get_by_role("link", name="Measure", exact=True).click()
    expect(shown.get_by_role("link", name="seeded")).to_be_visible()
    summary = client.get(f"{API}/tests/{plate}/analyses/{analysis['id']}").json()["summary"]
    assert summary["state"] == "complete" or summary["steps"]
    page.sound()


def test_a_test_without_calibration_is_given_one_at_its_head(
    page: Watched, client: httpx.Client, calibration: str
) -> None:
    test_id = new_test(client, name="later")
    shown = page.open(f"#/test/{test_id}")
    head = shown.locator('[data-role="calibration"]')
    expect(head).to_contain_text("This test names no calibration: choose one")
    head.get_by_label("Calibration").select_option(calibration)
    expect(shown.get_by_text("New analyses are measured with this calibration.")).to_be_visible()
    expect(head.get_by_label("Calibration")).to_have_value(calibration)
    expect(head).not_to_contain_text("names no calibration")
    assert client.get(f"{API}/tests/{test_id}").json()["calibration_id"] == calibration
    # other changes name the state that they were meant for, too
    shown.get_by_text("Name, specimen and notes").click()
    shown.get_by_label("Name", exact=True).first.fill("renamed")
    shown.get_by_role("button", name="Save", exact=True).click()
    expect(shown.get_by_role("heading", name="renamed")).to_be_visible()
    page.sound()


def test_a_test_is_measured_live_and_its_curves_are_drawn(page: Watched, client: httpx.Client, plate: str) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()
    shown = page.open(f"#/test/{plate}?at=live")
    panel = shown.get_by_role("region", name="Live values")
    panel.get_by_label("with a coarse field").check()
    panel.get_by_role("button", name="Measure live").click()
    expect(panel.locator('[data-role="live-values"] tr', has_text="e1")).to_contain_text("µm/m", timeout=SLOW)
    expect(
        panel.locator('[data-role="live-curves"]').get_by_role("img", name="Live curves of the gauges")
    ).to_be_visible(timeout=SLOW)
    # the field is drawn over the image, and again with a later frame
    map_of_field = panel.locator('[data-role="live-field"]')
    expect(map_of_field).to_have_attribute("data-frame", re.compile(r"\d+"), timeout=SLOW)
    expect(panel.get_by_role("img", name=re.compile("Colour bar from .*m"))).to_be_visible()
    first = map_of_field.get_attribute("data-frame") or ""
    expect(map_of_field).not_to_have_attribute("data-frame", first, timeout=SLOW)
    coloured = "c => c.getContext('2d').getImageData(c.width / 2, c.height / 2, 1, 1).data[3]"
    assert map_of_field.evaluate(coloured) == 255
    # a channel whose readings are posted is there to be chosen
    number = client.get(f"{API}/tests/{plate}/live").json()["values"]["number"]
    client.post(
        f"{API}/tests/{plate}/live/channels", json={"readings": [{"time_s": 0.0, "channels": {"force_n": 1.0}}]}
    ).raise_for_status()
    against = panel.get_by_label("Against")
    expect(against.locator("option", has_text="force_n")).to_have_count(1, timeout=SLOW)
    # the switch, and the screen opened again while it goes on
    shown = page.open("#/test")
    shown = page.open(f"#/test/{plate}?at=live")
    panel = shown.get_by_role("region", name="Live values")
    expect(panel.get_by_role("button", name="Measure live")).to_be_hidden()
    panel.get_by_role("button", name="Stop").click()
    expect(panel.locator('[data-role="live-state"]')).to_contain_text("ended", timeout=SLOW)
    assert client.get(f"{API}/tests/{plate}/live").json()["values"]["number"] >= number
