"""The region's tools in a browser: circles, adding and cutting, paint, mask files, the gauge in mm."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.page_bench import Watched
from tests.support.page_editor import HEIGHT, WIDTH, Editor, posted
from tests.support.service_rig import SMALL, plate_test

pytestmark = pytest.mark.timeout(300)
API = "/api/v1"
Y, X = np.mgrid[0:HEIGHT, 0:WIDTH]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("region") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def plate(client: httpx.Client) -> str:
    return plate_test(client)


def press(shown: Page, *names: str) -> None:
    for name in names:
        shown.get_by_role("button", name=name, exact=True).click()


def mask_of(region: dict[str, str]) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(region["mask_png_base64"]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) > 127


def test_circles_are_added_and_cut_out_and_can_be_set_by_numbers(page: Watched, plate: str) -> None:
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown)
    editor.tool("Circle")
    sent = posted(shown, "/texture", lambda: editor.drag((110, 100), (140, 100)))
    assert np.abs(np.array(sent["region"]["outlines"][0]["circle"]) - (110, 100, 30)).max() <= 1.0
    # three points of a rim, beside it
    editor.tool("3-point circle")
    press(shown, "Add")
    editor.show()
    sent = posted(shown, "/texture", lambda: [editor.click(*xy) for xy in ((150, 100), (170, 120), (190, 100))])
    assert np.abs(np.array(sent["region"]["outlines"][1]["circle"]) - (170, 100, 20)).max() <= 1.5
    # a bolt's hole
    editor.tool("Circle")
    press(shown, "Cut out")
    editor.show()
    sent = posted(shown, "/texture", lambda: editor.drag((110, 100), (118, 100)))
    hole = np.array(sent["region"]["holes"][0])
    assert np.abs(np.hypot(*(hole - hole.mean(axis=0)).T) - 8).max() <= 1.0
    assert len(sent["region"]["outlines"]) == 2
    # by numbers; what encloses nothing is told beside them
    numbers = shown.get_by_label("Circle 1: x, y of the centre; radius, px")
    numbers.fill("100, 90; 0")
    numbers.press("Enter")
    expect(shown.get_by_text("A circle's radius is 1 px or more.")).to_be_visible()
    numbers.fill("100, 90; 25")
    sent = posted(shown, "/texture", lambda: numbers.press("Enter"))
    assert sent["region"]["outlines"][0] == {"circle": [100, 90, 25]}
    sent = posted(shown, "/texture", lambda: press(shown, "Undo", "Undo", "Undo"))
    assert len(sent["region"]["outlines"]) == 1
    assert sent["region"]["holes"] == []
    # a circle by keyboard alone
    shown.get_by_role("button", name="New region", exact=True).press("Enter")
    shown.get_by_role("button", name="Circle", exact=True).press("Enter")
    for key in ("Enter", "Enter", "Shift+ArrowRight", "Shift+ArrowRight"):
        shown.keyboard.press(key)
    sent = posted(shown, "/texture", lambda: shown.keyboard.press("Enter"))
    assert sent["region"]["outlines"][0]["circle"][2] == 20
    page.sound()


def test_a_region_is_painted_inverted_saved_and_read_again(page: Watched, plate: str, tmp_path: Path) -> None:
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown)
    editor.tool("Brush")
    size = shown.get_by_label("Brush", exact=True)
    size.fill("30")
    size.press("Tab")
    editor.show()
    sent = posted(shown, "/texture", lambda: editor.drag((80, 100), (160, 100)))
    # a stroke is all that lies within half the brush of its line; its edge is on the screen's pixels
    away = np.hypot(np.maximum(np.abs(X - 120.0) - 40.0, 0.0), Y - 100.0)
    painted = mask_of(sent["region"])
    sure = np.abs(away - 15.0) > 1.5
    assert np.array_equal(painted[sure], (away < 15.0)[sure])
    editor.tool("Eraser")
    sent = posted(shown, "/texture", lambda: editor.drag((120, 60), (120, 140)))
    assert not mask_of(sent["region"])[60:140, 108:132].any()
    # back, and the other way round
    sent = posted(shown, "/texture", lambda: press(shown, "Undo"))
    assert np.array_equal(mask_of(sent["region"]), painted)
    sent = posted(shown, "/texture", lambda: press(shown, "Invert"))
    assert np.array_equal(mask_of(sent["region"]), ~painted)
    posted(shown, "/texture", lambda: press(shown, "Invert"))
    # to a file, and from one
    with shown.expect_download() as saved:
        press(shown, "Save the mask")
    saved.value.save_as(tmp_path / "mask.png")
    assert np.array_equal(cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_GRAYSCALE) > 127, painted)
    small, disc = tmp_path / "small.png", tmp_path / "disc.png"
    cv2.imwrite(str(small), np.full((10, 20), 255, np.uint8))
    drawn = np.hypot(X - 128, Y - 120) < 40
    cv2.imwrite(str(disc), drawn.astype(np.uint8) * 255)
    shown.get_by_label("Mask file").set_input_files(small)
    expect(shown.get_by_role("alert").filter(has_text="20 x 10 px, camera 1's image 256 x 240 px")).to_be_visible()
    sent = posted(shown, "/texture", lambda: shown.get_by_label("Mask file").set_input_files(disc))
    assert np.array_equal(mask_of(sent["region"]), drawn)
    expect(shown.locator('[data-role="mask"]')).to_contain_text(f"{drawn.sum():,}".replace(",", "\u202f"))
    # a rectangle is added to the paint
    editor.tool("Rectangle")
    press(shown, "Add")
    editor.show()
    sent = posted(shown, "/texture", lambda: editor.drag((20, 20), (60, 60)))
    both = mask_of(sent["region"])
    assert both[120, 128]
    assert both[30:55, 25:55].all()
    assert not both[100, 20]
    page.sound(422)  # a stroke is narrower than the subset that is set


def test_the_gauge_is_told_in_mm_and_warned_of_where_the_region_is_small(
    page: Watched, client: httpx.Client, plate: str
) -> None:
    scale = client.get(f"{API}/tests/{plate}/scale").json()["mm_per_px"]
    shown = page.open(f"#/test/{plate}?at=region")
    editor = Editor(shown)
    editor.drag((60, 60), (200, 180))
    shown.get_by_label("Subset", exact=True).fill("15")
    shown.get_by_label("Spacing", exact=True).fill("5")
    shown.get_by_label("Window", exact=True).fill("5")
    expect(shown.get_by_text("Virtual strain gauge: 35.00 px =")).to_have_text(
        f"Virtual strain gauge: 35.00 px = {35 * scale:.2f} mm wide."
    )
    warning = shown.locator('[data-role="gauge-warning"]')
    expect(warning).to_be_hidden()
    shown.get_by_label("Window", exact=True).fill("15")
    expect(warning).to_contain_text("wider than half of the region")
    shown.get_by_label("Window", exact=True).fill("31")
    expect(warning).to_contain_text("wider than the region")
    page.sound()
