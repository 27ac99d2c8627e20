"""Takes the pictures of the page that the README and docs/how_to/page.md show.

Run from the repository's root::

    python -m tests.bench.page.pictures [--data DIR] [--out docs/figures]

Without ``--data`` the plate's demo is run first (``stereorig demo --experiment plate``); with it, DIR is the folder
that such a demo wrote.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path

import httpx
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page

from stereorig.server.demo.process import running_service
from tests.bench.page.browser import browser, fresh_page
from tests.bench.page.speed import wait_for_rig
from tests.bench.speed.scaling import RIG, ROOT

FIGURES = ROOT / "docs" / "figures"
API = "/api/v1"
MAX_BYTES = 300_000  # bytes
PRESSURE_KPA = 689.0
REGION = ((86.0, 70.0), (426.0, 410.0))  # the paper's, px


def kept(page: Page, path: Path) -> None:
    """Keep what the window shows, with few enough colours to be small."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.save(path, optimize=True)
    for colours in (256, 128, 64):
        if path.stat().st_size < MAX_BYTES:
            break
        fewer(picture, colours).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB")


def fewer(picture: Image.Image, colours: int) -> Image.Image:
    """Bring a picture to so many colours: the commonest, which are grounds and letters, as they are, the rest shared."""
    pixels = np.asarray(picture).reshape(-1, 3)
    found, counts = np.unique(pixels, axis=0, return_counts=True)
    flat = found[np.argsort(-counts)[: colours // 4]]
    others = pixels[~np.isin(pixels @ [65536, 256, 1], flat @ [65536, 256, 1])]
    shared = Image.fromarray(others[None]).quantize(colours - len(flat), Image.Quantize.MAXCOVERAGE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*flat.ravel().tolist(), *(shared.getpalette() or [])])
    return picture.quantize(palette=palette, dither=Image.Dither.NONE)


def top(page: Page, selector: str) -> None:
    """Bring an element to the window's upper edge, below the bar."""
    page.locator(selector).first.evaluate(
        "one => { const bar = document.getElementById('bar').getBoundingClientRect().height;"
        " window.scrollTo({ top: one.getBoundingClientRect().top + window.scrollY - bar - 12, behavior: 'instant' }) }"
    )
    page.wait_for_timeout(400)


def begin(page: Page) -> None:
    """Go to the window's beginning."""
    page.evaluate("window.scrollTo(0, 0)")
    page.wait_for_timeout(500)


def settled(page: Page, shown: str) -> None:
    """Wait until this field is drawn."""
    page.wait_for_selector(f'canvas[data-role="map"][data-shown="{shown}"]', state="attached")
    page.wait_for_timeout(800)


def rig(page: Page, out: Path) -> None:
    page.wait_for_function("() => document.querySelectorAll('.chart canvas').length === 4")
    page.wait_for_timeout(12_000)  # a course of the focus figure
    kept(page, out / "page_rig.png")


def calibrate(page: Page, out: Path) -> None:
    page.wait_for_selector('[aria-label="Verdict"]')
    page.wait_for_selector('.view [data-role="nodes"]', state="attached")
    page.wait_for_timeout(1500)
    kept(page, out / "page_calibrate_plan.png")
    top(page, '[aria-label="Verdict"]')
    kept(page, out / "page_calibrate.png")


def capture(page: Page, out: Path) -> None:
    page.locator('[data-role="thumbnails"] button').last.click()
    page.wait_for_timeout(1500)
    kept(page, out / "page_test_steps.png")


def region(page: Page, out: Path) -> None:
    box = page.locator(".work .view .content > img").first.bounding_box()
    assert box is not None
    corners = [
        (box["x"] + (x + 0.5) / 512 * box["width"], box["y"] + (y + 0.5) / 480 * box["height"]) for x, y in REGION
    ]
    page.mouse.move(*corners[0])
    page.mouse.down()
    page.mouse.move(*corners[1], steps=4)
    page.mouse.up()
    page.get_by_label("Subset", exact=True).fill("21")
    page.locator('[data-role="texture"] .badge').wait_for()
    page.mouse.move(2, 2)
    page.wait_for_timeout(1000)
    kept(page, out / "page_test.png")


def results(page: Page, out: Path, name: str) -> None:
    settled(page, "10 w_mm reference")
    view = page.locator(".view .frame").first.bounding_box()
    assert view is not None
    page.mouse.click(view["x"] + 0.5 * view["width"], view["y"] + 0.5 * view["height"])
    page.wait_for_timeout(1000)
    begin(page)
    kept(page, out / f"{name}.png")


def surface(page: Page, out: Path) -> None:
    settled(page, "10 w_mm reference")
    page.get_by_role("button", name="3-D surface").click()
    page.wait_for_selector('.space[data-drawn="10 w_mm"]')
    page.get_by_label("Displacement ×").fill("20")
    page.get_by_label("Displacement ×").press("Tab")
    page.wait_for_timeout(1500)
    begin(page)
    kept(page, out / "page_surface.png")


def jobs(page: Page, out: Path) -> None:
    page.wait_for_selector("tbody tr")
    page.locator("tbody tr").first.click()
    page.wait_for_timeout(3500)
    kept(page, out / "page_jobs.png")


def take(made: Browser, url: str, out: Path) -> None:
    """Take all of them."""
    with httpx.Client(base_url=f"{url}{API}", timeout=120.0, trust_env=False) as client:
        client.put("/sim/scene", json={"scene": "plate", "load": PRESSURE_KPA}).raise_for_status()
        test_id = client.get("/tests").json()["tests"][-1]["id"]
        analysis_id = client.get(f"/tests/{test_id}").json()["analyses"][-1]["id"]
        calibration_id = client.get("/calibrations").json()["calibrations"][-1]["id"]
    field = f"results/{test_id}/{analysis_id}?step=10&field=w_mm"
    for address, draw in (
        ("rig", rig),
        (f"calibrate/{calibration_id}", calibrate),
        (f"test/{test_id}?at=capture", capture),
        (f"test/{test_id}?at=region", region),
        (field, lambda page, out: results(page, out, "page_results")),
        (field, surface),
        ("jobs", jobs),
    ):
        with fresh_page(made, color_scheme="light", locale="en-GB", timezone_id="UTC") as page:
            page.goto(f"{url}/#/{address}")
            draw(page, out)
    with fresh_page(made, color_scheme="dark", locale="en-GB", timezone_id="UTC") as page:
        page.goto(f"{url}/#/{field}")
        results(page, out, "page_dark")


def main() -> None:
    """Make the data if need be, serve it, take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder that a demo wrote")
    parser.add_argument("--out", type=Path, default=FIGURES, help="where the pictures go")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, browser() as made:
        demo = arguments.data or Path(folder) / "demo"
        if arguments.data is None:
            command = [
                sys.executable,
                "-m",
                "stereorig.server.cli",
                "demo",
                "--experiment",
                "plate",
                "--out",
                str(demo),
            ]
            subprocess.run(command, check=True, cwd=ROOT)
        with running_service(RIG, demo / "data", Path(folder) / "service.log") as url:
            wait_for_rig(url)
            take(made, url, arguments.out)


if __name__ == "__main__":
    main()
