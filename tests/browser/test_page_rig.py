"""The page in a browser: the shell, the rig's screen, jobs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.images import decode
from stereorig.server.http.access import KeyFile
from stereorig.server.workflows.service import Service
from tests.service.test_rig_comes_up import Bench, states, until_connected
from tests.support.page_bench import Watched, watched
from tests.support.service_rig import served, true_cameras
from tests.support.stage_service import rig_text, wait_until
from tests.support.tiny_rig import TINY

pytestmark = pytest.mark.timeout(180)


def test_both_live_views_come_and_nothing_is_asked_elsewhere(page: Watched) -> None:
    shown = page.open()
    for cam in ("cam1", "cam2"):
        image = shown.get_by_alt_text(f"Live view of {cam}", exact=True)
        expect(image).to_be_visible()
        shown.wait_for_function("image => image.naturalWidth === 160", arg=image.element_handle())
    expect(shown.get_by_role("button", name="STOP")).to_be_in_viewport()
    expect(shown.locator("#bar-stage")).to_contain_text("mm")
    expect(shown.locator(".chart canvas")).to_have_count(4)
    page.sound()


def test_the_grey_level_under_the_mouse_is_the_cameras_at_any_zoom(page: Watched, client: httpx.Client) -> None:
    client.put("/api/v1/sim/scene", json={"scene": "grid"}).raise_for_status()
    shown = page.open()
    view = shown.locator(".view").first
    frame = view.locator(".frame")
    readout = view.locator(".readout")
    for key, presses in (("0", 1), ("1", 1), ("+", 9)):
        frame.focus()
        for _ in range(presses):
            shown.keyboard.press(key)
        box = frame.bounding_box()
        assert box is not None
        shown.mouse.move(box["x"] + box["width"] / 2 + 3, box["y"] + box["height"] / 2 + 2)
        expect(readout).to_have_text(re.compile("grey"))
        shown.wait_for_timeout(300)
        column = int(readout.get_attribute("data-column") or -1)
        row = int(readout.get_attribute("data-row") or -1)
        # where that pixel lies by the transform that the browser drew it with
        corner = view.locator(".content > img").first.evaluate(
            "(image, at) => { const box = image.getBoundingClientRect(); return [(at[0] - box.left) / box.width * 160, "
            "(at[1] - box.top) / box.height * 144] }",
            [box["x"] + box["width"] / 2 + 3, box["y"] + box["height"] / 2 + 2],
        )
        assert (column, row) == (int(corner[0]), int(corner[1]))
        grey = re.search(r"grey (\d+) of 255", readout.inner_text())
        assert grey is not None
        grey_level = client.get("/api/v1/cameras/cam1/pixel", params={"x_px": column, "y_px": row}).json()["value"]
        assert abs(int(grey[1]) - grey_level) <= 15  # two frames, each with its noise of 2 grey levels
    page.sound()


def test_settings_are_set_and_what_the_camera_took_is_told(page: Watched, client: httpx.Client) -> None:
    shown = page.open()
    box = shown.get_by_role("region", name="cam2", exact=True)
    box.get_by_label("Exposure").fill("12.5")
    box.get_by_role("button", name="Set").click()
    expect(box.get_by_text("The camera applied 12.50 ms")).to_be_visible()
    assert client.get("/api/v1/cameras/cam2").json()["settings"]["exposure_ms"] == 12.5
    # beyond the camera's range: said beside the field, and nothing is sent
    box.get_by_label("Exposure").fill("5000")
    box.get_by_role("button", name="Set").click()
    field = box.locator(".field", has=shown.get_by_label("Exposure"))
    expect(field.get_by_role("alert")).to_have_text("Give 0.01 to 1000\u00a0ms, not 5000\u00a0ms.")
    expect(box.get_by_label("Exposure")).to_be_focused()
    expect(box.get_by_label("Exposure")).to_have_attribute("aria-invalid", "true")
    assert client.get("/api/v1/cameras/cam2").json()["settings"]["exposure_ms"] == 12.5
    box.get_by_label("Exposure").fill("10")
    expect(field.get_by_role("alert")).to_have_count(0)
    page.sound()
    client.patch("/api/v1/cameras/cam2", json={"exposure_ms": 10.0}).raise_for_status()


def test_the_exposure_is_searched_and_light_that_does_not_suffice_is_told_beside_it(
    page: Watched, client: httpx.Client
) -> None:
    client.put("/api/v1/sim/scene", json={"scene": "plate"}).raise_for_status()
    client.patch("/api/v1/cameras/cam2", json={"exposure_ms": 0.5}).raise_for_status()
    shown = page.open()
    box = shown.get_by_role("region", name="cam2", exact=True)
    box.get_by_role("button", name="Auto exposure").click()
    expect(box.get_by_text("% of full scale, none saturated")).to_be_visible()
    taken = client.get("/api/v1/cameras/cam2").json()["settings"]["exposure_ms"]
    assert float(box.get_by_label("Exposure").input_value()) == pytest.approx(taken, rel=1e-4)
    frame = decode(client.get("/api/v1/cameras/cam2/frame").content, name="cam2").pixels
    assert np.sort(frame.ravel())[-frame.size // 1000] == pytest.approx(0.8 * 255, rel=0.05)
    # less light than the longest exposure that is allowed can make up for
    client.put("/api/v1/sim/scene", json={"scene": "grid"}).raise_for_status()
    client.patch("/api/v1/cameras/cam2", json={"exposure_ms": 10.0}).raise_for_status()
    shown.route("**/cameras/cam2:expose", lambda route: route.continue_(post_data='{"longest_ms": 0.02}'))
    box.get_by_role("button", name="Auto exposure").click()
    field = box.locator(".field", has=shown.get_by_label("Exposure"))
    expect(field.get_by_role("alert")).to_contain_text("Take the cap off the lens")
    assert client.get("/api/v1/cameras/cam2").json()["settings"]["exposure_ms"] == 10.0
    page.sound(409)


def test_the_focus_figure_keeps_its_peak_and_says_how_far_it_is_from_it(page: Watched, client: httpx.Client) -> None:
    client.put("/api/v1/sim/scene", json={"scene": "plate"}).raise_for_status()
    shown = page.open()
    box = shown.get_by_role("region", name="cam1", exact=True)
    reading = box.locator('[data-role="focus"]')
    expect(reading).to_contain_text("at the peak")
    # the lens is capped: little but noise is seen, and the peak stays what it was
    client.patch("/api/v1/cameras/cam1", json={"exposure_ms": 0.01}).raise_for_status()
    expect(box.get_by_text("noise only")).to_be_visible(timeout=15_000)
    expect(reading).to_contain_text("no figure")
    client.patch("/api/v1/cameras/cam1", json={"exposure_ms": 10.0}).raise_for_status()
    expect(reading).to_contain_text("at the peak")
    page.sound()


def test_the_picture_fills_its_frame(page: Watched) -> None:
    shown = page.open()
    frame = shown.locator(".view .frame").first.bounding_box()
    picture = shown.get_by_alt_text("Live view of cam1", exact=True).bounding_box()
    assert frame is not None
    assert picture is not None
    assert picture["width"] * picture["height"] > 0.97 * frame["width"] * frame["height"]
    histogram = shown.get_by_role("img", name="Histogram of cam1").bounding_box()
    assert histogram is not None
    assert histogram["width"] > 500
    assert histogram["height"] > 180


def test_a_moved_camera_is_told_while_it_is_looked_at(page: Watched, client: httpx.Client) -> None:
    api = "/api/v1"
    client.put(f"{api}/sim/scene", json={"scene": "plate"}).raise_for_status()
    shown = page.open()
    check = shown.locator('[data-role="live-check"]')
    expect(check).to_contain_text("None has been accepted yet.")
    expect(check.get_by_role("link", name="Calibrate")).to_have_attribute("href", "#/calibrate")
    cameras = json.dumps(true_cameras(TINY))
    made = client.post(f"{api}/calibrations:import", files={"file": ("c.json", cameras)}).json()["id"]
    client.put(f"{api}/calibrations/{made}/review", json={"decision": "accepted"}).raise_for_status()
    page.open("#/jobs")
    page.open()
    expect(check).to_contain_text("as calibrated", timeout=120_000)
    # five hundredths of a degree over 3600 px of pinhole distance: three pixels
    bump = {"bump_cam2": [0.05, 0, 0, 0, 0, 0]}
    client.put(f"{api}/sim/scene", json={"scene": "plate", "params": bump}).raise_for_status()
    expect(check).to_contain_text("cameras have moved")
    expect(check.get_by_role("link", name="Calibrate again")).to_be_visible()
    client.put(f"{api}/sim/scene", json={"scene": "plate", "params": {"bump_cam2": [0] * 6}}).raise_for_status()
    page.sound(409)


def test_overlays_lie_over_the_image(page: Watched) -> None:
    shown = page.open()
    view = shown.locator(".view").first
    view.get_by_label("Overlay of cam1").select_option("texture")
    overlay = view.locator(".content > img").nth(1)
    shown.wait_for_function("image => image.naturalWidth > 0", arg=overlay.element_handle())
    picture, map_ = view.locator(".content > img").first.bounding_box(), overlay.bounding_box()
    assert picture == map_
    expect(view.get_by_text("green: error below 0.01 px")).to_be_visible()
    page.sound()


def test_charts_take_the_colours_of_the_theme(page: Watched) -> None:
    shown = page.open()
    expect(shown.locator(".chart canvas")).to_have_count(4)
    light, dark = "207,214,218", "55,66,74"  # --line of the style sheet
    drawn = f"""colour => {{
        const c = document.querySelector('.chart canvas'), seen = new Set();
        const of = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        for (let k = 0; k < of.length; k += 4) if (of[k + 3] === 255) seen.add(String(of.slice(k, k + 3)));
        return seen.has(colour) && !seen.has(colour === '{light}' ? '{dark}' : '{light}');
    }}"""
    shown.wait_for_function(drawn, arg=light)
    shown.emulate_media(color_scheme="dark")
    shown.wait_for_function(drawn, arg=dark)
    colours = shown.get_by_role("button", name="Light or dark colours")
    colours.click()  # light, whatever the system has
    shown.wait_for_function(drawn, arg=light)
    # on a light system too, the first press changes what is seen
    shown.emulate_media(color_scheme="light")
    colours.click()
    expect(colours).to_have_attribute("title", "Colours: as the system")
    colours.click()
    shown.wait_for_function(drawn, arg=dark)
    page.sound()


def test_jog_moves_the_axis_and_stop_is_told(page: Watched, client: httpx.Client) -> None:
    shown = page.open()
    axis = shown.locator('[data-axis="1"]')
    axis.get_by_role("button", name="Jog axis 1 forward").click()
    expect(axis.locator('[data-role="position"]')).to_have_text(re.compile(r"^1(\.0+)? ?mm|^1\.0"))
    shown.get_by_role("button", name="STOP").click()
    expect(shown.get_by_text("The stop command was sent")).to_be_visible()
    assert client.get("/api/v1/stage").json()["axes"][0]["position_mm"] == pytest.approx(1.0, abs=0.01)
    page.sound()


def test_by_keyboard_alone_and_on_a_tablet(chromium: Browser, client: httpx.Client) -> None:
    with watched(
        chromium, str(client.base_url).rstrip("/"), viewport={"width": 820, "height": 1180}, has_touch=True
    ) as page:
        shown = page.open()
        shown.keyboard.press("Tab")
        expect(shown.get_by_text("Skip to the content")).to_be_focused()
        wide = shown.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth")
        assert not wide
        shown.get_by_role("link", name="Jobs & system").focus()
        shown.keyboard.press("Enter")
        expect(shown.get_by_role("heading", name="Jobs and system")).to_be_visible()
        shown.keyboard.press("Escape")
        shown.keyboard.press("Escape")
        expect(shown.get_by_text("The stop command was sent")).to_be_visible()
        page.sound()


def test_where_keys_are_needed_the_page_asks_for_one(chromium: Browser, service: Service, client: httpx.Client) -> None:
    key = KeyFile(service.folder.root).add("page-operator", "operator")
    with served(service, keys_required=True) as guarded, watched(chromium, str(guarded.base_url).rstrip("/")) as page:
        page.page.goto(page.origin)
        dialog = page.page.get_by_role("dialog", name="Log in")
        dialog.get_by_label("Key").fill("sr_wrong")
        dialog.get_by_role("button", name="Log in").click()
        expect(dialog.get_by_text("No user has this key.")).to_be_visible()
        dialog.get_by_label("Key").fill(key)
        dialog.get_by_role("button", name="Log in").click()
        expect(page.page.get_by_text("page-operator (operator)")).to_be_visible()
        # pictures and events come with the cookie
        image = page.page.get_by_alt_text("Live view of cam1", exact=True)
        page.page.wait_for_function("image => image.naturalWidth === 160", arg=image.element_handle())
        page.sound(401)


@pytest.mark.fault(61)
def test_a_device_that_comes_late_or_is_lost_is_shown_as_it_is(
    chromium: Browser, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = Bench(monkeypatch, {"stage": ("esp301", (1, 2))})
    bench.off("cam2")
    with (
        bench.serve(parse_config(rig_text(url=f'"{bench.url()}"')), tmp_path / "data") as client,
        watched(chromium, str(client.base_url).rstrip("/")) as made,
    ):
        until_connected(client, "cam1")
        shown = made.open()
        late = shown.get_by_role("region", name="cam2", exact=True)
        controllers = shown.locator('[data-role="controllers"]')
        expect(late).to_contain_text("looked for")
        expect(controllers).to_contain_text("looked for")
        bench.on("cam2")
        bench.on("stage")
        # its settings and their ranges were not known when the page was opened
        expect(late.get_by_label("Exposure")).to_have_value("10")
        expect(late).to_contain_text("0.01 to 1000 ms")
        expect(late.get_by_role("img", name="Histogram of cam2")).to_be_visible()
        expect(controllers).to_contain_text("connected")
        bench.off("cam2")
        expect(late).to_contain_text("lost since")
        for cam in ("cam1", "cam2"):  # none of its figures passes for a present one
            box = shown.get_by_role("region", name=cam, exact=True)
            expect(box.get_by_role("img", name=f"Histogram of {cam}")).to_be_hidden()
            expect(box.locator('[data-role="focus"]')).not_to_contain_text("at the peak")
        bench.on("cam2")
        expect(shown.get_by_text("ready", exact=True)).to_be_visible()
        bench.off("stage")
        wait_until(lambda: states(client)["stage1"] == "lost")
        expect(shown.get_by_text("without the stage")).to_be_visible()
        expect(controllers).to_contain_text("lost since")
        bench.on("stage")
        expect(controllers).to_contain_text("connected")
        made.sound(503)
