"""Nothing drawn is lost: the region and its settings outlive the screen, a reload, a crash of browser and service."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.copied_tests import CONFIG, write_test_folder
from tests.support.page_bench import Watched, watched
from tests.support.page_editor import Editor
from tests.support.requirements import ROOT

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SIZE = (160, 144)
TEST, OTHER = "t000001-abcdef", "t000002-abcdef"


class Served:
    """A service as its own process, so that it can be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: subprocess.Popen[str] | None = None
        self.url = ""

    def start(self) -> str:
        command = [sys.executable, "-m", "stereorig.server.cli", "serve", "--config", str(self.folder / "rig.toml")]
        self.process = subprocess.Popen(
            [*command, "--port", "0", "--data", str(self.folder / "data")],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stdout is not None
        self.url = next(word for word in self.process.stdout.readline().split() if word.startswith("http://"))
        self.url = self.url.rstrip("/")
        return self.url

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.communicate()

    def workspace(self, test_id: str) -> dict[str, object]:
        found: dict[str, object] = httpx.get(f"{self.url}{API}/tests/{test_id}/workspace", trust_env=False).json()
        return found


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("kept")
    (folder / "rig.toml").write_text(CONFIG)
    tests = folder / "data" / "tests"
    write_test_folder(tests / TEST, 1)
    shutil.copytree(tests / TEST, tests / OTHER)
    document = tests / OTHER / "test.json"
    document.write_text(document.read_text().replace(TEST, OTHER))
    made = Served(folder)
    made.start()
    yield made
    made.kill()


def opened(page: Watched, test_id: str = TEST) -> Page:
    shown = page.open(f"#/test/{test_id}?at=region")
    Editor(shown, size=SIZE)
    return shown


def saved(shown: Page) -> None:
    expect(shown.locator('[data-role="saved"]')).to_have_text("Saved with the test.")


def check_all_there(shown: Page, outline: str) -> None:
    """As it was drawn and set, each control by itself."""
    expect(shown.get_by_label("Rectangle: x, y of each point, px")).to_have_value(outline)
    expect(shown.get_by_label("Crack 1: x, y of each point, px")).to_have_value("60, 60; 70, 66.5")
    expect(shown.get_by_label("Seed 1: x, y of each point, px")).to_have_value("50, 50")
    expect(shown.get_by_label("Subset", exact=True)).to_have_value("21")
    expect(shown.get_by_label("Smoothing window")).to_have_value("5")
    expect(shown.get_by_label("Tensor")).to_have_value("hencky")
    expect(shown.get_by_role("textbox", name="Steps", exact=True)).to_have_value("0")


def test_region_and_settings_outlive_screen_reload_browser_and_service(chromium: Browser, served: Served) -> None:
    with watched(chromium, served.url) as page:
        shown = opened(page)
        editor = Editor(shown, size=SIZE)
        editor.drag((40, 40), (110, 100))
        # a crack and a seed by their keys, then their numbers
        for tool, points in (("Crack line", [(60, 60), (70, 66)]), ("Seed", [(50, 50)])):
            editor.tool(tool)
            for xy in points:
                editor.click(*xy)
                shown.wait_for_timeout(350)
            if tool == "Crack line":
                editor.key("Enter")
        for label, value in (("Crack 1", "60, 60; 70, 66.5"), ("Seed 1", "50, 50")):
            box = shown.get_by_label(f"{label}: x, y of each point, px")
            box.fill(value)
            box.press("Enter")
        shown.get_by_label("Subset", exact=True).fill("21")
        shown.get_by_text("Advanced", exact=True).click()
        shown.get_by_label("Smoothing window").fill("5")
        shown.get_by_label("Tensor").select_option("hencky")
        shown.get_by_role("textbox", name="Steps", exact=True).fill("0")
        outline = shown.get_by_label("Rectangle: x, y of each point, px").input_value()
        # the screen is left at once: what is open is saved then
        shown.get_by_role("link", name="All tests").click()
        opened(page)
        check_all_there(shown, outline)
        shown.reload()
        Editor(shown, size=SIZE)
        check_all_there(shown, outline)
        # an even subset is not kept in the place of the last good one
        shown.get_by_label("Subset", exact=True).fill("22")
        shown.get_by_label("Spacing", exact=True).fill("9")
        saved(shown)
        settings = served.workspace(TEST)["settings"]
        assert isinstance(settings, dict)
        assert (settings["subset_px"], settings["spacing_px"]) == (21, 9)
        shown.get_by_label("Subset", exact=True).fill("21")
        page.sound_beside_captures(422)  # the texture of an even subset
        served.kill()
        shown.get_by_label("Spacing", exact=True).fill("8")
        expect(shown.locator('[data-role="saved"]')).to_contain_text("Not saved: the service does not answer")
    # a browser and a service of their own; the image comes late, the region is not cut at a border not known yet
    served.start()
    with watched(chromium, served.url) as page:
        page.page.route("**/preview*", lambda route: (time.sleep(1.0), route.continue_()))
        shown = opened(page)
        check_all_there(shown, outline)
        expect(shown.get_by_label("Spacing", exact=True)).to_have_value("9")
        shown.get_by_label("Spacing", exact=True).fill("8")
        saved(shown)

        # kept as a recipe, and taken by another test
        shown.get_by_text("Recipes: kept for the next specimen").click()
        shown.get_by_role("button", name="Keep as a recipe").click()
        assert shown.get_by_label("Name", exact=True).last.evaluate("input => input.validationMessage") != ""
        shown.get_by_label("Name", exact=True).last.fill("strip <b>")
        shown.get_by_role("button", name="Keep as a recipe").click()
        expect(shown.get_by_role("cell", name="strip <b>")).to_be_visible()
        shown = opened(page, OTHER)
        expect(shown.get_by_text("No region yet.")).to_be_visible()
        shown.get_by_text("Recipes: kept for the next specimen").click()
        shown.get_by_label("Take region and settings from").select_option(label="strip <b>")
        shown.get_by_role("button", name="Take", exact=True).first.click()
        expect(shown.get_by_label("Rectangle: x, y of each point, px")).to_have_value(outline)
        expect(shown.get_by_label("Subset", exact=True)).to_have_value("21")
        saved(shown)
        mine, other = (served.workspace(test_id) for test_id in (TEST, OTHER))
        for name in ("region", "settings", "image_size_px"):
            assert other[name] == mine[name], name
        page.sound_beside_captures()


def test_two_windows_do_not_overwrite_each_other(chromium: Browser, served: Served) -> None:
    with watched(chromium, served.url) as one, watched(chromium, served.url) as two:
        first, second = opened(one), opened(two)
        first.get_by_label("Subset", exact=True).fill("23")
        saved(first)
        second.get_by_label("Subset", exact=True).fill("25")
        told = second.locator('[data-role="saved"]')
        expect(told).to_contain_text("Changed in another window since.")
        assert served.workspace(TEST)["settings"]["subset_px"] == 23  # type: ignore[index]
        told.get_by_role("button", name="Keep this one").click()
        expect(told).to_have_text("Saved with the test.")
        assert served.workspace(TEST)["settings"]["subset_px"] == 25  # type: ignore[index]
