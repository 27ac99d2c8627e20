"""Debian's Chromium on the page: its messages and requests are watched."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

if os.environ.get("CI", "").lower() != "true":
    pytest.importorskip("playwright", reason="pip install playwright to test the page")
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.bench.page import browser as page_browser
from tests.support.patience import busy

# what has the focus, how it shows, and whether it lies in the window and not under the bar
FOCUS = """() => {
    const node = document.activeElement;
    if (!node || node === document.body) return null;
    const box = node.getBoundingClientRect(), look = getComputedStyle(node), over = getComputedStyle(node, '::after');
    const bar = document.getElementById('bar');
    const width = style => parseFloat(style) || 0;
    if (!node.dataset.stop) node.dataset.stop = String(document.querySelectorAll('[data-stop]').length + 1);
    return {
        stop: Number(node.dataset.stop), name: node.getAttribute('aria-label') ?? node.textContent.trim(),
        tag: node.tagName, drawn: look.outlineStyle !== 'none' && width(look.outlineWidth) >= 2
            || over.content !== 'none' && width(over.borderTopWidth) >= 2
            || node.tagName === 'circle' && look.stroke === 'rgb(255, 255, 255)',
        seen: box.width > 0 && box.bottom > 0 && box.top < innerHeight
            && (bar.contains(node) || node.matches('.skip') || box.bottom > bar.getBoundingClientRect().bottom),
    };
}"""
# what a mouse can use and the keyboard has not been on
UNREACHED = """() => [...document.querySelectorAll('a[href], button, input, select, textarea, summary, .grab, .frame')]
    .filter(node => node.checkVisibility() && !node.disabled && !node.dataset.stop && !node.closest('.notice'))
    .map(node => node.outerHTML.slice(0, 120))"""


def chromium() -> str:
    """Return the program's path; in CI it must be there."""
    path = page_browser.chromium()
    if path is None:
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail("CI needs chromium")
        pytest.skip("chromium not found: apt install chromium to test the page")
    return path


@dataclass
class Watched:
    """A page and everything that it did which it should not do."""

    page: Page
    origin: str
    outside: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def open(self, address: str = "") -> Page:
        """Go to a screen (``#/rig``) and wait until it is drawn."""
        self.page.goto(f"{self.origin}/{address}")
        screen = address.removeprefix("#/").split("/")[0] or "rig"
        self.page.wait_for_selector(f'[data-screen="{screen}"] h1')
        return self.page

    def sound(self, *expected: int) -> None:
        """Assert that nothing went elsewhere, and that nothing was refused but with these statuses."""
        assert self.outside == []
        assert [line for line in self.refused if int(line.split()[0]) not in expected] == []
        # the browser itself reports a refused request as an error of the console
        unexpected = [line for line in self.complaints if not ("Failed to load resource" in line and expected)]
        assert unexpected == []

    def sound_beside_captures(self, *expected: int) -> None:
        """Assert as :meth:`sound`; a camera that is busy with a capture may have no figures."""
        busy = [line for line in self.refused if line.startswith("409")]
        assert [one for one in busy if not re.search(r"/cameras/cam[12]/stats$", one)] == []
        self.sound(*expected, *([409] if busy else []))


def browser() -> contextlib.AbstractContextManager[Browser]:
    """Start Chromium without a window."""
    chromium()  # reports what is missing
    return page_browser.browser()


@contextlib.contextmanager
def watched(made: Browser, origin: str, **options: Any) -> Iterator[Watched]:
    """Open a page of its own that is watched."""
    settings: dict[str, Any] = {"viewport": page_browser.SIZE} | options
    context: BrowserContext = made.new_context(**settings)
    patience_ms = 30_000 * busy()
    context.set_default_timeout(patience_ms)
    expect.set_options(timeout=patience_ms)
    page = context.new_page()
    watch = Watched(page, origin)

    def asked(url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme in ("http", "https", "ws", "wss") and f"{parts.scheme}://{parts.netloc}" != origin:
            watch.outside.append(url)

    page.on("request", lambda request: asked(request.url))
    page.on("console", lambda message: message.type == "error" and watch.complaints.append(message.text))
    page.on("pageerror", lambda error: watch.complaints.append(str(error)))
    page.on("response", lambda answer: answer.status >= 400 and watch.refused.append(f"{answer.status} {answer.url}"))
    try:
        yield watch
    finally:
        context.close()


def undrawn(client: httpx.Client) -> None:
    """Forget what earlier tests drew: the page keeps it with each test."""
    for test in client.get("/api/v1/tests").json()["tests"]:
        client.put(f"/api/v1/tests/{test['id']}/workspace", json={}).raise_for_status()


def tabbed(page: Page) -> list[dict[str, Any]]:
    """Press Tab until it goes round: what had the focus, whether that was drawn and could be seen."""
    order: list[dict[str, Any]] = []
    for _ in range(200):
        page.keyboard.press("Tab")
        now = page.evaluate(FOCUS)
        if now is None or (order and now["stop"] < order[-1]["stop"]):
            break
        order.append(now)
    return order
