"""The page's tutorial, clicked through as it is printed: bold names, fields with their values, texts that appear."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from stereorig.server.demo.process import running_service
from tests.support.page_bench import Watched, watched
from tests.support.page_editor import Editor
from tests.support.plate_truth import check_plate_field
from tests.support.requirements import ROOT
from tests.support.service_rig import wait_for_rig

pytestmark = pytest.mark.timeout(500)
TUTORIAL = ROOT / "docs" / "tutorial" / "page.md"
RIG = ROOT / "config" / "sim_paper.toml"
API = "/api/v1"
SLOW = 200_000
SIZE = (512, 480)
# drawn as the tutorial states, px of camera 1: a sixth of the picture free on each side, and a line across its middle
REGION = ((86.0, 70.0), (426.0, 410.0))
LINE = ((120.0, 240.0), (400.0, 240.0))
# a screen, a name to click, a field with its value, a text to appear
STEP = re.compile(
    r"Screen \*\*(?P<screen>[^*]+)\*\*|\*\*(?P<click>[^*]+)\*\*"
    r"|\*(?P<field>[^*]+)\*\s+`(?P<value>[^`]+)`|`(?P<text>[^`]+)`"
)


@dataclass(frozen=True)
class Instruction:
    """One thing that the tutorial asks for: ``kind`` is screen, click, field or text."""

    kind: str
    name: str
    value: str = ""


def instructions() -> list[Instruction]:
    """Read the numbered steps of the tutorial, in their order."""
    text = TUTORIAL.read_text(encoding="utf-8")
    steps = re.findall(r"^\d+\. (.*(?:\n {3}.*)*)", text, re.MULTILINE)
    assert len(steps) == 13
    found = []
    for step in steps:
        for screen, click, field, value, text in STEP.findall(" ".join(step.split())):
            kind = "screen" if screen else "click" if click else "field" if field else "text"
            found.append(Instruction(kind, screen or click or field or text, value))
    return found


class Operator:
    """Does what an instruction asks for, in the browser."""

    def __init__(self, page: Watched) -> None:
        self.shown = page.page
        self.main = self.shown.locator("main")
        self.saved = 0  # files

    def do(self, asked: Instruction) -> None:
        """Click, fill in or wait, and check that the page has no complaint."""
        if asked.kind == "screen":
            link = self.shown.get_by_role("navigation", name="Screens").get_by_role("link", name=asked.name, exact=True)
            link.click()
            expect(link).to_have_attribute("aria-current", "page")
            expect(self.main.get_by_role("heading", level=1)).to_be_visible()
        elif asked.kind == "field":
            self._fill(asked.name, asked.value)
        elif asked.kind == "text":
            expect(self.main.get_by_text(asked.name, exact=True).first).to_be_visible(timeout=SLOW)
        else:
            self._click(asked.name)
        expect(self.shown.locator(".notice.bad")).to_have_count(0)

    def _fill(self, label: str, value: str) -> None:
        control = self.main.get_by_label(label, exact=True).first
        expect(control).to_be_enabled()
        if control.evaluate("control => control.tagName") == "SELECT":
            control.select_option(label=value)
            expect(control.locator("option:checked")).to_have_text(value)
        else:
            control.fill(value)

    def _named(self, name: str) -> Locator:
        """Return the one button, link or heading to open that has exactly this name."""
        button, link = (self.main.get_by_role(role, name=name, exact=True) for role in ("button", "link"))
        summary = self.main.locator("summary").get_by_text(name, exact=True)
        expect(button.or_(link).or_(summary).first).to_be_visible()
        for kind in (button, link, summary):
            if kind.count():
                return kind.first
        raise AssertionError(name)

    def _click(self, name: str) -> None:
        control = self._named(name)
        if name == "Open the report":
            with self.shown.context.expect_page(timeout=SLOW) as opened:
                control.click()
            opened.value.wait_for_load_state()
            expect(opened.value.locator("body")).to_contain_text("689 kPa")
            opened.value.close()
            return
        if name == "Save the file":
            with self.shown.expect_download(timeout=SLOW) as saved:
                control.click()
            assert Path(saved.value.path()).stat().st_size > 1000
            self.saved += 1
            return
        control.click()
        if name == "Rectangle":
            editor = Editor(self.shown, size=SIZE)
            editor.drag(*REGION)
        elif name == "Line":
            canvas = Editor(self.shown, size=SIZE)
            canvas.drag(*LINE)
            expect(self.main.locator('[data-role="line-chart"]')).to_have_attribute("data-answer", re.compile("value"))
        # an action is over when its button is no longer busy
        expect(self.main.locator('[aria-busy="true"]')).to_have_count(0, timeout=SLOW)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """The service on the paper's rig, as `make serve` starts it, with an empty data folder."""
    folder = tmp_path_factory.mktemp("page_tutorial")
    with (
        running_service(RIG, folder / "data", folder / "service.log") as url,
        httpx.Client(base_url=url, timeout=60.0, trust_env=False) as made,
    ):
        wait_for_rig(made)
        yield made


def strain_is_drawn(shown: Page) -> None:
    expect(shown.locator('canvas[data-role="map"][data-shown="2 exx reference"]')).to_be_attached()


def test_the_tutorial_leads_from_the_grid_to_the_strain_map(chromium: Browser, client: httpx.Client) -> None:
    asked = instructions()
    assert [one.name for one in asked if one.kind == "screen"].count("Rig") == 2
    with watched(chromium, str(client.base_url).rstrip("/")) as page:
        page.open()
        operator = Operator(page)
        for one in asked:
            operator.do(one)
        strain_is_drawn(page.page)
        page.sound_beside_captures()
    test_id = client.get(f"{API}/tests").json()["tests"][-1]["id"]
    analysis = client.get(f"{API}/tests/{test_id}").json()["analyses"][-1]["id"]
    path = f"{API}/tests/{test_id}/analyses/{analysis}"
    settings = client.get(path).json()["settings"]
    assert (settings["subset_px"], settings["spacing_px"]) == (33, 10)
    check_plate_field(client, np.array(client.get(f"{path}/steps/2/fields/w_mm").json()["values"], dtype=float))
    assert operator.saved == 1
