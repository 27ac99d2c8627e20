"""The page's editor of regions: pixels of camera 1's picture clicked and dragged, requests caught."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from playwright.sync_api import Page, Request

# of the small rig's images, px
WIDTH, HEIGHT = 256, 240


class Editor:
    """A camera's picture, and the window positions of its pixels by the transform that the browser drew it with."""

    def __init__(self, shown: Page, camera: int = 1, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self.page, self.size = shown, size
        self.view = shown.locator(".view").nth(camera - 1)
        self.image = self.view.locator(".content > img").first
        shown.wait_for_function(f"image => image.naturalWidth === {size[0]}", arg=self.image.element_handle())
        self.show()

    def show(self) -> None:
        """Bring all of it into the window: what lies outside cannot be clicked."""
        self.view.evaluate("view => view.scrollIntoView({block: 'end', behavior: 'instant'})")

    def position(self, x: float, y: float) -> tuple[float, float]:
        box = self.image.bounding_box()
        assert box is not None
        return box["x"] + (x + 0.5) / self.size[0] * box["width"], box["y"] + (y + 0.5) / self.size[1] * box["height"]

    def click(self, x: float, y: float) -> None:
        self.page.mouse.click(*self.position(x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.page.mouse.move(*self.position(*start))
        self.page.mouse.down()
        middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        self.page.mouse.move(*self.position(*middle))
        self.page.mouse.move(*self.position(*end))
        self.page.mouse.up()

    def key(self, name: str, times: int = 1) -> None:
        frame = self.view.locator(".frame")
        frame.evaluate("frame => frame.focus({preventScroll: true})")
        for _ in range(times):
            self.page.keyboard.press(name)

    def tool(self, name: str) -> None:
        self.page.get_by_role("toolbar", name="Drawing").get_by_role("button", name=name, exact=True).click()
        self.show()


def asked(shown: Page, path: str, act: Callable[[], object], key: str = "", *like: Any) -> dict[str, Any]:
    """Return the body that the page sends to an operation once this is done: the one with these numbers under a key.

    A drawing is checked a little later, so that an earlier body may still be under way.
    """

    def right(request: Request) -> bool:
        if request.method != "POST" or not request.url.endswith(path):
            return False
        if not key:
            return True
        found = np.array(json.loads(request.post_data or "{}")["region"].get(key))
        return found.shape == np.shape(like[0]) and bool(np.abs(found - like[0]).max() <= like[1])

    with shown.expect_request(right, timeout=60_000) as info:
        act()
    return dict(json.loads(info.value.post_data or "{}"))


def posted(shown: Page, path: str, act: Callable[[], object], wait_s: float = 0.6) -> dict[str, Any]:
    """Return the last body that the page sends to an operation after this is done, once none has come for a while."""
    seen: list[dict[str, Any]] = []

    def note(request: Request) -> None:
        if request.method == "POST" and request.url.endswith(path):
            seen.append(dict(json.loads(request.post_data or "{}")))

    shown.on("request", note)
    act()
    for _ in range(round(20 / wait_s)):
        count = len(seen)
        shown.wait_for_timeout(1000 * wait_s)
        if seen and count == len(seen):
            break
    shown.remove_listener("request", note)
    return seen[-1]
