"""The page under fingers, 390 px wide: a region dragged, the picture moved and pinched, a point tapped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from playwright.sync_api import Browser, CDPSession, Locator, Page, expect

from tests.support import results_page
from tests.support.page_audit import PHONE
from tests.support.page_bench import Watched, undrawn, watched
from tests.support.page_editor import Editor
from tests.support.results_page import API, Bench, shown

bench = results_page.bench  # fixture

pytestmark = pytest.mark.timeout(600)

Spot = tuple[float, float]


@pytest.fixture
def page(chromium: Browser, bench: Bench) -> Iterator[Watched]:
    undrawn(bench.client)
    size = {"width": PHONE[0], "height": PHONE[1]}
    origin = str(bench.client.base_url).rstrip("/")
    with watched(chromium, origin, viewport=size, has_touch=True, is_mobile=True, device_scale_factor=2) as made:
        yield made


class Fingers:
    """One or two fingers on the glass, as the browser itself is told of them."""

    def __init__(self, at: Page) -> None:
        self.session: CDPSession = at.context.new_cdp_session(at)

    def _tell(self, kind: str, spots: Sequence[Spot]) -> None:
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(spots)]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def move(self, starts: Sequence[Spot], ends: Sequence[Spot], steps: int = 8) -> None:
        """Put fingers down one after the other, move them on straight lines, lift them."""
        for count in range(1, len(starts) + 1):
            self._tell("touchStart", starts[:count])
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            self._tell(
                "touchMove", [tuple(np.add(a, share * np.subtract(b, a))) for a, b in zip(starts, ends, strict=True)]
            )
        self._tell("touchEnd", [])


def box_of(one: Locator) -> dict[str, float]:
    box = one.bounding_box()
    assert box is not None
    return dict(box)


def held_in(at: Page) -> None:
    """Fail where the page is wider than the glass."""
    wider = at.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert wider == 0


def test_a_region_is_dragged_by_a_finger_and_two_fingers_zoom_instead_of_drawing(page: Watched, bench: Bench) -> None:
    at = page.open(f"#/test/{bench.test_id}?at=region")
    panel = at.get_by_role("region", name="Region and analysis")
    panel.locator(".view").first.scroll_into_view_if_needed()
    before_it = panel.evaluate("panel => [...document.querySelectorAll('.view')].findIndex(one => panel.contains(one))")
    editor = Editor(at, camera=1 + before_it)
    fingers = Fingers(at)
    start, end = (70.0, 60.0), (180.0, 170.0)
    fingers.move([editor.position(*start)], [editor.position(*end)])
    expect(panel.locator('[data-role="texture"]')).to_contain_text("speckle quality")
    expect(at.locator('[data-role="saved"]')).to_contain_text("Saved with the test")
    kept = bench.client.get(f"{API}/tests/{bench.test_id}/workspace").json()["region"]
    np.testing.assert_allclose(kept["rectangle"], [*start, *end], atol=1.0)
    # the tool still draws; a second finger makes it a pinch, and the drawing stays as it is
    editor.show()
    before = box_of(editor.image)
    middle = editor.position(125.0, 115.0)
    near = [(middle[0] - 30.0, middle[1]), (middle[0] + 30.0, middle[1])]
    far = [(middle[0] - 75.0, middle[1] + 20.0), (middle[0] + 75.0, middle[1] + 20.0)]
    fingers.move(near, far)
    after = box_of(editor.image)
    assert after["width"] / before["width"] == pytest.approx(150.0 / 60.0, rel=0.05)
    # and what lay between the fingers still does
    x, y = editor.position(125.0, 115.0)
    assert (x, y) == pytest.approx((middle[0], middle[1] + 20.0), abs=3.0)
    at.wait_for_timeout(600)
    assert bench.client.get(f"{API}/tests/{bench.test_id}/workspace").json()["region"] == kept
    held_in(at)
    page.sound()


def test_a_map_is_pinched_and_moved_and_a_point_tapped(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    fingers = Fingers(at)
    canvas = at.locator('canvas[data-role="map"]')
    frame = at.locator(".view .frame").first
    frame.scroll_into_view_if_needed()
    whole, before = box_of(frame), box_of(canvas)
    middle = (whole["x"] + whole["width"] / 2, whole["y"] + whole["height"] / 2)
    fingers.move(
        [(middle[0] - 40.0, middle[1]), (middle[0] + 40.0, middle[1])],
        [(middle[0] - 80.0, middle[1]), (middle[0] + 80.0, middle[1])],
    )
    zoomed = box_of(canvas)
    assert zoomed["width"] / before["width"] == pytest.approx(2.0, rel=0.05)
    scrolled = at.evaluate("scrollY")
    fingers.move([middle], [(middle[0] + 40.0, middle[1] - 30.0)])
    moved = box_of(canvas)
    assert (moved["x"] - zoomed["x"], moved["y"] - zoomed["y"]) == pytest.approx((40.0, -30.0), abs=3.0)
    assert at.evaluate("scrollY") == scrolled  # the picture moved, not the page
    # nothing of this was a tap
    probe = at.locator('[data-role="probe"]')
    expect(probe).to_contain_text("Click a point")
    x_px, y_px = 120.0, 110.0
    at.touchscreen.tap(
        moved["x"] + (x_px + 0.5) / 256 * moved["width"], moved["y"] + (y_px + 0.5) / 240 * moved["height"]
    )
    answer = bench.client.get(
        f"{bench.path()}/probe", params={"x_px": x_px, "y_px": y_px, "step": 2, "frame": "specimen"}
    ).json()
    expect(probe).to_contain_text(f"row {answer['row']}, column {answer['col']}")
    held_in(at)
    page.sound()
