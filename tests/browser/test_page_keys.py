"""The page by keyboard alone: what is reached, where the focus is and stays, the stop from anywhere, drawing."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.page_bench import FOCUS, UNREACHED, Watched, tabbed
from tests.support.page_editor import asked
from tests.support.service_rig import SMALL, plate_test

pytestmark = pytest.mark.timeout(300)

API = "/api/v1"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("keys") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def plate(client: httpx.Client) -> str:
    return plate_test(client)


def focused(at: Page) -> str:
    focus = at.evaluate(FOCUS)
    return "" if focus is None else str(focus["name"])


@pytest.mark.parametrize("screen", ["rig", "calibrate", "test", "region", "jobs"])
def test_tab_reaches_everything_and_the_focus_is_seen(page: Watched, plate: str, screen: str) -> None:
    at = page.open({"test": f"#/test/{plate}", "region": f"#/test/{plate}?at=region"}.get(screen, f"#/{screen}"))
    if screen in ("test", "region"):
        at.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true })")
        if screen == "test":
            expect(at.get_by_role("button", name="Save the metadata")).to_be_visible()
        else:
            at.get_by_role("button", name="Rectangle in the middle").click()
            expect(at.locator('[data-role="texture"]')).to_contain_text("texture")
        at.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
        at.locator("#bar").click(position={"x": 2, "y": 2})
    elif screen == "rig":
        expect(at.locator('[data-axis="2"]')).to_be_visible()
    else:
        at.wait_for_timeout(1000)
    order = tabbed(at)
    names = [one["name"] for one in order]
    if screen not in ("test", "region"):
        assert names[0] == "Skip to the content"
    way = ["Rig", "Calibrate", "Test", "Capture", "Region", "Measure", "Results"]
    beside = ["Live", "Verify"] if screen in ("test", "region") else []
    bar = ["stereorig", *way, *beside, "Jobs & system", "API", "Keys", "Light or dark colours", "STOP"]
    first = names.index("stereorig")
    # a step of the way has its number before it, or a tick
    assert [re.sub(r"^[\d\u2713]", "", name) for name in names[first : first + len(bar)]] == bar
    assert [one for one in order if not one["drawn"]] == []
    assert [one for one in order if not one["seen"]] == []
    assert [one for one in at.evaluate(UNREACHED) if screen not in ("test", "region") or "skip" not in one] == []
    page.sound()


def test_the_skip_link_goes_to_the_content_of_the_same_screen(page: Watched) -> None:
    at = page.open("#/jobs")
    expect(at.locator("#main").locator("a, button, input, select, summary").first).to_be_visible()  # to come to by Tab
    at.keyboard.press("Tab")
    at.keyboard.press("Enter")
    expect(at.locator("#main")).to_be_focused()
    at.keyboard.press("Tab")
    assert at.evaluate("document.getElementById('main').contains(document.activeElement)")
    expect(at.get_by_role("heading", name="Jobs and system")).to_be_visible()


def stopped(at: Page, act: Callable[[], object]) -> None:
    with at.expect_response(lambda answer: answer.url.endswith("/stage:stop") and answer.status == 200):
        act()


def twice(at: Page) -> None:
    at.keyboard.press("Escape")
    at.keyboard.press("Escape")


def test_stop_from_anywhere(page: Watched, plate: str) -> None:
    at = page.open("#/rig")
    # while a number is being typed
    at.get_by_label("Exposure").first.focus()
    stopped(at, lambda: twice(at))
    # in a drawing that uses Escape itself
    page.open(f"#/test/{plate}?at=region")
    at.get_by_role("button", name="Polygon", exact=True).press("Enter")
    at.keyboard.press("ArrowLeft")
    at.keyboard.press("Enter")
    stopped(at, lambda: twice(at))
    # in a dialog: by its own button, and by the keys
    at.get_by_role("button", name="Keys").press("Enter")
    dialog = at.get_by_role("dialog", name="Keys")
    expect(dialog.get_by_text("Stops every axis at once")).to_be_visible()
    stopped(at, lambda: dialog.get_by_role("button", name="STOP").press("Enter"))
    stopped(at, lambda: twice(at))
    expect(dialog).to_have_count(0)
    # one Escape is none
    at.wait_for_timeout(1600)
    asked_for: list[str] = []
    at.on("request", lambda request: asked_for.append(request.url))
    at.keyboard.press("Escape")
    at.wait_for_timeout(1600)
    at.keyboard.press("Escape")
    at.wait_for_timeout(300)
    assert not [url for url in asked_for if url.endswith("/stage:stop")]
    page.sound()


def test_dialogs_hold_the_focus_and_give_it_back(page: Watched, plate: str) -> None:
    at = page.open(f"#/test/{plate}")
    at.locator('[data-step="0"] button').press("Enter")
    opener = at.get_by_role("button", name="Delete …")
    opener.press("Enter")
    dialog = at.get_by_role("dialog", name="Delete step 0?")
    expect(dialog.get_by_role("button", name="Cancel")).to_be_focused()  # what does no harm
    seen = []
    for _ in range(7):
        at.keyboard.press("Tab")
        seen.append(focused(at))
    assert seen == ["Delete", "STOP", "Cancel", "Delete", "STOP", "Cancel", "Delete"]
    at.keyboard.press("Shift+Tab")
    at.keyboard.press("Shift+Tab")
    at.keyboard.press("Shift+Tab")
    assert focused(at) == "Delete"
    at.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(opener).to_be_focused()
    page.sound()


def test_the_focus_stays_where_something_is_drawn_anew(page: Watched, client: httpx.Client, plate: str) -> None:
    at = page.open("#/rig")
    forth = at.get_by_role("button", name="Jog axis 2 forward")
    forth.press("Enter")
    expect(forth).not_to_have_attribute("aria-busy", "true")
    expect(forth).to_be_focused()
    # the list of jobs is drawn anew with each event
    page.open("#/jobs")
    row = at.locator("tr.pick button").first
    name = row.inner_text()
    row.focus()
    job = client.post(f"{API}/stage/moves", json={"positions_mm": {"2": 0.0}}).json()["job"]["id"]
    expect(at.locator("tr.pick button").first).to_have_text(job)
    assert focused(at) == name
    # where a link led to another screen, Tab goes on from the screen's beginning
    row.press("Enter")
    page.open(f"#/test/{plate}?at=region")
    at.get_by_role("link", name="All tests").press("Enter")
    expect(at.get_by_role("heading", name="Tests", exact=True)).to_be_visible()
    expect(at.locator("#main")).to_be_focused()
    page.sound()


def walk(at: Page, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Move the cross-hair by whole pixels."""
    for k, (back, forth) in enumerate((("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))):
        way = round(end[k] - start[k])
        key = forth if way > 0 else back
        for _ in range(abs(way) // 10):
            at.keyboard.press(f"Shift+{key}")
        for _ in range(abs(way) % 10):
            at.keyboard.press(key)


def aim(at: Page, camera: int = 1) -> tuple[float, float]:
    cross = at.locator(".view").nth(camera - 1).locator(".aim")
    return float(cross.get_attribute("data-x") or "nan"), float(cross.get_attribute("data-y") or "nan")


def test_a_region_is_drawn_by_keyboard(page: Watched, plate: str) -> None:
    at = page.open(f"#/test/{plate}?at=region")
    image = at.get_by_alt_text("Reference image of cam1")
    at.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
    frame = at.locator(".view .frame").first

    def draw(tool: str, points: list[tuple[float, float]], close: bool = True) -> None:
        at.get_by_role("button", name=tool, exact=True).press("Enter")
        expect(frame).to_be_focused()
        shows = at.locator(".aim").count() == 0
        at.keyboard.press("ArrowUp")
        here = aim(at)
        if shows:  # in the middle of what is seen
            assert here == pytest.approx((127.5, 119.5), abs=1)
        for position in points:
            walk(at, here, position)
            assert aim(at) == pytest.approx(position, abs=0.05)
            at.keyboard.press("Enter")
            here = position
        if close:
            at.keyboard.press("Enter")

    corners: list[tuple[float, float]] = [(80, 70), (171, 155)]
    sent = asked(at, "/texture", lambda: draw("Rectangle", corners, close=False), "rectangle", [80, 70, 171, 155], 0.05)
    assert sent["region"]["holes"] == []
    outline: list[tuple[float, float]] = [(75, 72), (168, 66), (180, 149), (91, 160)]
    asked(at, "/texture", lambda: draw("Polygon", outline), "polygon", outline, 0.05)
    hole: list[tuple[float, float]] = [(110, 100), (125, 101), (117, 113)]
    asked(at, "/texture", lambda: draw("Hole", hole), "holes", [hole], 0.05)
    crack: list[tuple[float, float]] = [(130, 125), (142, 131)]
    asked(at, "/texture", lambda: draw("Crack line", crack), "cracks", [crack], 0.05)
    # Escape leaves: the cross-hair goes, what is begun goes, and arrows move the picture again
    draw("Polygon", [(100, 100)], close=False)
    before = at.locator(".view .content").first.get_attribute("style")
    at.keyboard.press("Escape")
    expect(at.locator(".aim")).to_have_count(0)
    expect(at.get_by_role("button", name="Move", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(frame).to_be_focused()
    at.keyboard.press("ArrowLeft")
    assert at.locator(".view .content").first.get_attribute("style") != before
    # points that are there: Tab goes to them, Delete takes one away
    at.keyboard.press("0")
    at.keyboard.press("Tab")
    assert focused(at).startswith("Corner 1 of the region")
    asked(at, "/texture", lambda: at.keyboard.press("Alt+ArrowRight"), "polygon", [(75.1, 72), *outline[1:]], 1e-6)
    assert focused(at).startswith("Corner 1 of the region, at 75.1")
    asked(at, "/texture", lambda: at.keyboard.press("Delete"), "polygon", outline[1:], 1e-6)
    assert focused(at)
    page.sound()


def test_seeds_in_both_views_by_keyboard(page: Watched, client: httpx.Client, plate: str) -> None:
    at = page.open(f"#/test/{plate}?at=region")
    image = at.get_by_alt_text("Reference image of cam2")
    at.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
    at.get_by_role("button", name="Rectangle in the middle").press("Enter")
    assert focused(at)  # the button is gone, the focus is not
    frames = at.locator(".view .frame")
    at.get_by_role("button", name="Seed", exact=True).press("Enter")
    expect(frames.first).to_be_focused()
    at.keyboard.press("ArrowUp")
    walk(at, aim(at), (140, 100))
    with at.expect_response(lambda answer: "/seeds:check" in answer.url):
        at.keyboard.press("Enter")
    expect(frames.nth(1)).to_be_focused()
    line = at.locator('[data-role="epipolar"]')
    expect(line).to_have_count(1)
    at.keyboard.press("ArrowUp")
    start = aim(at, 2)
    # it begins on the line that the service gives
    checked = client.post(f"{API}/tests/{plate}/seeds:check", json={"seeds": [[140, 100]], "reference": 0}).json()
    course = np.array(checked["seeds"][0]["line_px"])
    assert np.hypot(*(course - start).T).min() < 0.1
    position = (start[0] + 12, start[1] - 1)
    walk(at, start, position)
    with at.expect_request(lambda request: "/seeds:check" in request.url) as info:
        at.keyboard.press("Enter")
    sent = json.loads(info.value.post_data or "{}")
    assert sent["seeds"] == [[140, 100]]
    assert np.array(sent["seeds_cam2"]) == pytest.approx(np.array([position]), abs=0.05)
    expect(frames.first).to_be_focused()
    page.sound()


def test_pointing_by_keyboard_reads_the_pixel(page: Watched, client: httpx.Client) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "grid"}).raise_for_status()
    at = page.open("#/rig")
    image = at.get_by_alt_text("Live view of cam1", exact=True)
    at.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
    at.locator(".view .frame").first.focus()
    at.keyboard.press("Enter")
    for zoom in ("1", "+", "+"):
        at.keyboard.press(zoom)
        at.keyboard.press("Shift+ArrowLeft")
        at.keyboard.press("ArrowDown")
        x, y = aim(at)
        readout = at.locator(".view .readout").first
        expect(readout).to_have_attribute("data-column", str(round(x)))
        expect(readout).to_have_attribute("data-row", str(round(y)))
        expect(readout).to_contain_text("grey")
        # the cross-hair is in the window
        assert at.locator(".aim").evaluate(
            "cross => { const b = cross.querySelector('path').getBoundingClientRect(), f = cross.closest('.frame')"
            ".getBoundingClientRect(); return b.left < f.right && b.right > f.left }"
        )
    page.sound()
