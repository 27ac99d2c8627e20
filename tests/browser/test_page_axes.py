"""Axes of the specimen on the page: a tension along the image's vertical, the system frame at 45 degrees in it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route, expect

from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.store.indexing.entries import analysis_entry
from tests.support import results_page
from tests.support.gauge_field import SUBSET, make_field
from tests.support.page_bench import Watched, watched
from tests.support.results_page import API, Bench
from tests.support.tension import LATERAL, TENSION, pulled, shape

bench = results_page.bench  # fixture

pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def page(chromium: Browser, bench: Bench) -> Iterator[Watched]:
    with watched(chromium, str(bench.client.base_url).rstrip("/")) as made:
        yield made


@pytest.fixture(scope="module")
def strip(bench: Bench) -> str:
    """Results of a tension of 2,000 um/m along the image's vertical, without noise."""
    tests = bench.service.tests
    stored = tests.analyses.read(bench.test_id, bench.analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "inputs", "software")}
    document = tests.analyses.create(bench.test_id, {**kept, "steps": [0, 1], "label": "tension"})
    bench.service.catalog.put_entry("analysis", bench.test_id, document.id, analysis_entry(document))
    folder = tests.analyses.path(bench.test_id, document.id)
    for n, motion in enumerate((None, pulled)):
        field = make_field(motion, shape=shape)
        strain = None if motion is None else surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
        inputs = {"calibration": "aa", "reference_cam1": "bb"}
        write_field(folder / f"step_{n:04d}.nc", field, Provenance({"subset_px": SUBSET}, inputs, "1", step=n), strain)
    return document.id


def reads(at: Page, strain: float, tolerance: float) -> None:
    """Wait until the mean in the statistics is a strain, um/m."""
    at.wait_for_function(
        "([wanted, tolerance]) => { const mean = [...document.querySelectorAll('[data-role=statistics] dt')]"
        ".find(one => one.textContent === 'mean')?.nextElementSibling.textContent.replace('\u2212', '-');"
        " return Math.abs(parseFloat(mean) - wanted) <= tolerance }",
        arg=[strain, tolerance],
    )


def opened(page: Watched, bench: Bench, strip: str, name: str) -> Page:
    page.open(f"#/results/{bench.test_id}/{strip}?step=1&field={name}")
    page.page.wait_for_selector(f'canvas[data-shown="1 {name} reference"]', state="attached")
    expect(page.page.locator(".triad")).to_have_count(1)
    return page.page


def directions(at: Page) -> list[float]:
    """Where X and Y point in the picture."""
    triad = at.locator(".triad")
    return [float(v) for axis in "xy" for v in (triad.get_attribute(f"data-{axis}") or "").split()]


def test_a_tension_along_the_images_vertical_reads_as_one_and_files_keep_the_system_frame(
    page: Watched, bench: Bench, strip: str
) -> None:
    for name, strain in (("exx", LATERAL), ("eyy", TENSION), ("exy", 0.0)):
        at = opened(page, bench, strip, name)
        reads(at, 1e6 * strain, 3.0)  # float32 of neighbours 0.14 mm apart
        expect(at.locator('[data-role="statistics"]')).to_contain_text("principal strains, mean")
        axis = at.locator('[data-role="principal-axis"]').inner_text()  # the tension's, down the image
        assert abs(float(axis.removesuffix("° from X").replace("\N{MINUS SIGN}", "-"))) == pytest.approx(90.0, abs=0.5)
        assert directions(at) == pytest.approx([1.0, 0.0, 0.0, 1.0], abs=0.01)
    system = bench.field(1, "eyy", strip, frame="system")
    assert 1e6 * np.nanmean(system) == pytest.approx(1e6 * (TENSION + LATERAL) / 2.0, abs=5.0)
    assert bench.client.get(f"{bench.path(strip)}/steps/1/fields/eyy").json()["values"][5][5] == system[5, 5]
    # and on the page by choice, which the address keeps
    at.get_by_label("Axes", exact=True).select_option("system")
    expect(at.get_by_text("axes: the calibration's")).to_be_visible()
    reads(at, 1e6 * (LATERAL - TENSION) / 2.0, 5.0)  # of a tensor turned by 45 degrees about Z
    expect(at.locator(".triad")).to_have_attribute("aria-label", re.compile("the calibration's"))
    half = 0.5**0.5
    assert [abs(v) for v in directions(at)] == pytest.approx([half] * 4, abs=0.01)
    at.reload()
    expect(at.get_by_label("Axes", exact=True)).to_have_value("system")
    page.sound()


def test_two_drawings_at_once_list_the_principal_strains_once(page: Watched, bench: Bench, strip: str) -> None:
    held: list[Route] = []
    at = opened(page, bench, strip, "w_mm")
    at.route(re.compile("fields/e1"), lambda route: held.append(route))  # both drawings wait for these strains
    at.get_by_label("Field", exact=True).select_option("exx")
    at.get_by_label("Colours", exact=True).select_option("turbo")
    while not held:
        at.wait_for_timeout(20)
    for route in held:
        route.continue_()
    expect(at.locator('[data-role="principal-axis"]')).to_have_count(1)
    at.wait_for_timeout(300)
    expect(at.locator('[data-role="principal-axis"]')).to_have_count(1)
    page.sound()


def test_axes_are_chosen_by_clicks_and_kept_with_the_test(page: Watched, bench: Bench, strip: str) -> None:
    at = opened(page, bench, strip, "exx")
    # what the axes are now comes after the first press: it does not stand in the place of what to click
    at.route("**/frame", lambda route: (time.sleep(1.0), route.continue_()), times=1)
    at.locator('[data-role="frame"] > summary').click()
    at.get_by_role("button", name="X along a line").click()
    at.wait_for_timeout(1500)
    state = at.locator('[data-role="frame-state"]')
    expect(state).to_contain_text("where X begins (1 of 2)")
    box = at.locator('canvas[data-role="map"]').bounding_box()
    assert box is not None
    for y_px in (70.0, 140.0):  # down the picture: X along the tension
        at.mouse.click(box["x"] + 100.5 / 256 * box["width"], box["y"] + (y_px + 0.5) / 240 * box["height"])
    expect(state).to_contain_text("X along a line of two positions")
    expect(at.get_by_text("axes: the specimen's (best plane, X along a line")).to_be_visible()
    reads(at, 1e6 * TENSION, 10.0)  # half a pixel on 70 turns X by 0.4 degrees at most
    kept = bench.client.get(f"{API}/tests/{bench.test_id}/frame").json()
    assert kept["chosen"]
    assert kept["frame"]["kind"] == "plane"
    at.get_by_role("button", name="Best plane, X along the image's rows").click()
    expect(state).to_contain_text("Usual axes: best plane")
    reads(at, 1e6 * LATERAL, 3.0)
    page.sound()
