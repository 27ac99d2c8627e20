"""A screen of the page in every size and both colours: axe, sideways scrolling, words that lie over each other."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from playwright.sync_api import Page

if os.environ.get("CI", "").lower() != "true":
    pytest.importorskip("axe_playwright_python", reason="pip install axe-playwright-python to test the page")
from axe_playwright_python.base import AXE_SCRIPT

Audit = Callable[[str], None]
Style = tuple[str, tuple[int, int]]

RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]
DESK, ACROSS, UPRIGHT = (1280, 800), (1024, 768), (768, 1024)
STYLES: list[Style] = [("light", DESK), ("dark", DESK), ("light", ACROSS), ("dark", UPRIGHT)]
# axe takes seconds on a full screen: colours are looked at in both schemes, what is folded away at both widths
AXE_STYLES: list[Style] = [("light", DESK), ("dark", UPRIGHT)]
WIDE, PHONE = (1440, 900), (390, 844)
EVERY_SIZE: list[Style] = [(scheme, size) for size in (WIDE, ACROSS, PHONE) for scheme in ("light", "dark")]
AXE_AT: list[Style] = [("light", WIDE), ("dark", PHONE)]
# a folder: each screen is saved there as it is seen at each size
PICTURES = "STEREORIG_PAGE_PICTURES"
RUN = """async rules => {
    const told = await axe.run(document, {runOnly: {type: 'tag', values: rules}, resultTypes: ['violations']});
    const found = told.violations.map(one => `${one.id} (${one.help}): `
        + one.nodes.map(node => `${node.target} ${node.failureSummary}`).join(' | '));
    return [found, told.passes.length];
}"""
# Pieces of text that lie over each other, buttons that cut their words. What lies over a picture on purpose, and what
# a box that scrolls or cuts hides, is left out; glyphs are lower than their line, hence the quarter
COLLISIONS = """() => {
    const pieces = [], found = [], words = node => `"${node.textContent.trim().slice(0, 40)}"`;
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node; node = walker.nextNode()) {
        const parent = node.parentElement;
        if (!node.data.trim() || !parent.checkVisibility({visibilityProperty: true, opacityProperty: true})) continue;
        if (parent.closest('.view .frame, .space, #notices, .unseen, .skip, option, dialog, script, style')) continue;
        const range = document.createRange();
        range.selectNodeContents(node);
        for (const box of range.getClientRects()) {
            let {left, right} = box, top = box.top + box.height / 4, bottom = box.bottom - box.height / 4;
            for (let at = parent; at && at !== document.body; at = at.parentElement) {
                const style = getComputedStyle(at);
                if (style.overflowX === 'visible' && style.overflowY === 'visible') continue;
                const edge = at.getBoundingClientRect();
                left = Math.max(left, edge.left); right = Math.min(right, edge.right);
                top = Math.max(top, edge.top); bottom = Math.min(bottom, edge.bottom);
            }
            if (right - left > 1 && bottom - top > 1) pieces.push({node, left, right, top, bottom});
        }
    }
    pieces.sort((a, b) => a.top - b.top);
    pieces.forEach((one, i) => {
        for (const other of pieces.slice(i + 1)) {
            if (other.top >= one.bottom - 1) break;
            if (other.node === one.node) continue;
            const across = Math.min(one.right, other.right) - Math.max(one.left, other.left);
            if (across > 1.5) found.push(`${words(one.node)} lies over ${words(other.node)}`);
        }
    });
    for (const button of document.querySelectorAll('button, .button')) {
        if (!button.checkVisibility() || button.querySelector('img, canvas')) continue;
        if (button.scrollWidth > button.clientWidth + 1) found.push(`the button ${words(button)} cuts its words`);
    }
    return [found, pieces.length];
}"""
DRAWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def auditor(at: Page, styles: Sequence[Style] = STYLES, axe_at: Sequence[Style] | None = None) -> Audit:
    """Return what fails where the page's present state is wrong in any of these styles; axe only in some, if named."""

    def run(state: str) -> None:
        if at.evaluate("typeof axe") == "undefined":
            at.evaluate(AXE_SCRIPT)
        found: list[str] = []
        for scheme, (width, height) in styles:
            at.set_viewport_size({"width": width, "height": height})
            at.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            at.evaluate("scrollTo(0, 0)")  # the bar stands at the head, over nothing
            at.evaluate(DRAWN)
            where = f"{state}, {scheme}, {width} x {height}"
            if axe_at is None or (scheme, (width, height)) in axe_at:
                violations, passed = at.evaluate(RUN, RULES)
                assert passed > 10, "axe has looked at nothing"
                found += [f"{where}: {one}" for one in violations]
            wider = at.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            if wider > 0:
                found.append(f"{where}: {wider} px wider than the window")
            collisions, pieces = at.evaluate(COLLISIONS)
            assert pieces > 5, "no text was looked at"
            found += [f"{where}: {one}" for one in collisions]
            save(at, f"{state} {width} {scheme}")
        assert not found, "\n".join(found)

    return run


def in_every_size(at: Page) -> Audit:
    """Return an audit for the middle of a user's work: every size and scheme, and the window as it was at the end."""
    look = auditor(at, EVERY_SIZE, AXE_AT)

    def run(state: str) -> None:
        before = at.viewport_size
        place = at.evaluate("[scrollX, scrollY]")
        try:
            look(state)
        finally:
            at.emulate_media(color_scheme="light")
            if before is not None:
                at.set_viewport_size(before)
            at.evaluate("place => scrollTo(...place)", place)
            at.evaluate(DRAWN)

    return run


def save(at: Page, name: str) -> None:
    """Save the whole page as a picture where that was asked for."""
    folder = os.environ.get(PICTURES)
    if not folder:
        return
    Path(folder).mkdir(parents=True, exist_ok=True)
    at.screenshot(path=Path(folder) / f"{re.sub(r'[^a-z0-9]+', '_', name.lower())}.png", full_page=True)
