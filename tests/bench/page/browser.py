"""The page in Debian's Chromium, for the scripts that measure it and take its pictures."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

SIZE = {"width": 1280, "height": 800}


def chromium() -> str | None:
    """Return the program's path; None where there is none."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """Start Chromium without a window.

    Raises
    ------
    SystemExit
        Where there is none.
    """
    path = chromium()
    if path is None:
        raise SystemExit("Chromium was not found: apt-get install chromium")
    with sync_playwright() as playwright:
        # tests and containers run as root, where Chromium's sandbox cannot; the 3-D view is rendered by software
        made = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--enable-unsafe-swiftshader"])
        try:
            yield made
        finally:
            made.close()


@contextlib.contextmanager
def fresh_page(made: Browser, **options: Any) -> Iterator[Page]:
    """Open a page that has nothing in its cache; ``options`` are those of Playwright's ``new_context``."""
    settings: dict[str, Any] = {"viewport": SIZE} | options
    context = made.new_context(**settings)
    context.set_default_timeout(120_000)
    try:
        yield context.new_page()
    finally:
        context.close()
