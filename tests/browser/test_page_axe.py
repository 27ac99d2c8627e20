"""axe on every screen of the page in its states: light and dark, on a desk and on a tablet both ways up."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from stereorig.server.workflows.service import Service
from tests.support import results_page
from tests.support.page_audit import AXE_STYLES, Audit, auditor
from tests.support.page_bench import Watched, watched
from tests.support.results_page import ENDS, LINE, Bench, given, shown
from tests.support.service_rig import served, tiny_config, wait_for_rig

bench, page = results_page.bench, results_page.page  # fixtures

pytestmark = pytest.mark.timeout(500)

API = "/api/v1"
AREA = ("Area left", "Area top", "Area right", "Area bottom")


@pytest.fixture
def audit(page: Watched) -> Audit:
    """Fail where axe finds anything on the page in its present state, light or dark, or it is wider than the screen."""
    return auditor(page.page, axe_at=AXE_STYLES)


def unfold(at: Page) -> None:
    at.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true })")


def test_axe_finds_what_is_wrong(page: Watched, audit: Audit) -> None:
    """So that the others can fail."""
    page.open("#/jobs")
    page.page.evaluate("document.querySelector('main').insertAdjacentHTML('beforeend', '<a href=\"#/rig\"></a>')")
    with pytest.raises(AssertionError, match="link-name"):
        audit("a link without a text")


def test_with_nothing_yet(chromium: Browser, tmp_path: Path) -> None:
    service = Service(tiny_config(), tmp_path / "data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            with watched(chromium, str(client.base_url).rstrip("/")) as page:
                for screen in ("calibrate", "test", "results", "jobs"):
                    page.open(f"#/{screen}")
                    auditor(page.page, axe_at=AXE_STYLES)(f"{screen} with nothing yet")
                page.sound()
    finally:
        service.close()


def test_rig(page: Watched, audit: Audit) -> None:
    at = page.open("#/rig")
    for cam in ("cam1", "cam2"):
        image = at.get_by_alt_text(f"Live view of {cam}", exact=True)
        at.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
    expect(at.locator(".chart canvas")).to_have_count(4)
    unfold(at)
    at.get_by_label("Overlay of cam1").select_option("texture")
    expect(at.get_by_text("green: error below 0.01 px")).to_be_visible()
    at.get_by_role("button", name="Cross-hair").first.click()
    audit("live views, a map over one")
    at.get_by_label("Exposure").first.fill("50000")
    at.get_by_role("button", name="Set").first.click()
    expect(at.get_by_role("alert").filter(has_text="50000")).to_be_visible()
    audit("a refused exposure")
    page.sound(409, 422)


def test_calibrate(page: Watched, bench: Bench, audit: Audit) -> None:
    at = page.open("#/calibrate")
    expect(at.get_by_text("middle of the volume")).to_be_attached()  # folded
    expect(at.get_by_role("region", name="Views")).to_be_visible()
    unfold(at)
    expect(at.get_by_text("middle of the volume")).to_be_visible()
    audit("a calibration")
    at.get_by_role("button", name="Discard").first.click()
    expect(at.get_by_role("dialog")).to_be_visible()
    audit("the question whether to discard it")
    at.keyboard.press("Escape")
    at.goto(f"{page.origin}/#/calibrate/c000099-ffffff")
    expect(at.locator(".problem")).to_contain_text("c000099-ffffff")
    audit("a calibration that is not there")
    page.sound(404)


def test_tests(page: Watched, bench: Bench, audit: Audit) -> None:
    at = page.open("#/test")
    at.get_by_role("button", name="Make the test").click()
    expect(at.get_by_role("alert")).to_be_visible()
    audit("tests, a new one without a name")
    page.open(f"#/test/{bench.test_id}")
    unfold(at)
    expect(at.get_by_role("button", name="Save the metadata")).to_be_visible()
    at.locator('[data-step="1"] button').click()
    expect(at.locator('[data-role="quality"]')).to_contain_text("Step 1")
    audit("a test and a step of it")
    at.get_by_role("button", name="Delete …").click()
    expect(at.get_by_role("dialog")).to_be_visible()
    audit("the question whether to delete a step")
    at.get_by_role("button", name="Cancel").click()
    screens = at.get_by_role("navigation", name="Screens")
    for name in ("Capture", "Measure", "Live", "Verify", "Region"):
        screens.get_by_role("link", name=name, exact=True).click()
        if name == "Region":
            at.get_by_role("button", name="Rectangle in the middle").click()
            expect(at.locator('[data-role="texture"]')).to_contain_text("texture")
            at.get_by_label("texture map").check()
        unfold(at)
        audit(f"a test, screen {name}")
    page.sound()


def test_results(page: Watched, bench: Bench, audit: Audit) -> None:
    at = page.open("#/results")
    expect(at.get_by_role("heading", name="plate <b>&")).to_be_visible()
    audit("which results there are")
    shown(page, bench)
    unfold(at)
    given(at, LINE, (80, 90, 160, 90))
    given(at, ENDS, (120, 70, 120, 160))
    given(at, AREA, (90, 90, 150, 140))
    for button in at.get_by_role("button", name="Use").all():
        button.click()
        unfold(at)  # what is read comes to the front, alone
    for role in ("line-chart", "extensometer-chart"):
        expect(at.locator(f'[data-role="{role}"] canvas')).to_be_visible()
    expect(at.locator('[data-role="area"] table').first).to_be_visible()
    expect(at.get_by_role("button", name="Save the file")).to_be_visible()
    at.locator(".view .frame").first.click()
    at.locator('[data-role="probe"] table').first.wait_for(state="attached")
    at.wait_for_timeout(500)
    unfold(at)  # what is read comes to the front, alone
    expect(at.locator('[data-role="probe"] table').first).to_be_visible()
    audit("a field with gauges, a probe and everything open")
    shown(page, bench, name="status")
    audit("a field of flags")
    page.sound()


def test_results_in_space_and_side_by_side(page: Watched, bench: Bench, audit: Audit) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="3-D surface").click()
    expect(at.locator(".space")).to_have_attribute("data-drawn", "2 w_mm")
    audit("the surface in space")
    at.get_by_role("button", name="Side by side").click()
    expect(at.locator('canvas[data-role="map-other"]')).to_have_attribute("data-shown", "2 w_mm reference")
    audit("two analyses side by side")
    at.get_by_label("Right view").select_option("difference")
    expect(
        at.locator('[data-role="difference-histogram"] canvas, [data-role="difference-histogram"] p')
    ).to_be_visible()
    audit("their difference")
    page.sound()


def test_jobs(page: Watched, bench: Bench, audit: Audit) -> None:
    at = page.open("#/jobs")
    at.locator("tr.pick button").first.click()
    expect(at.get_by_role("heading", name="Log")).to_be_visible()
    unfold(at)
    audit("a job and the system")
    page.sound()


def test_the_report_and_its_facts(page: Watched, bench: Bench) -> None:
    at = page.open(f"#/test/{bench.test_id}")
    at.get_by_text("Metadata for the report").click()
    at.get_by_label("Laboratory").fill("Room <7> & 8")
    camera = at.get_by_role("group", name="Camera 1 and its lens")
    camera.get_by_label("f-number").fill("5.6")
    at.get_by_role("button", name="Save the metadata").click()
    expect(at.get_by_text("The metadata are saved.")).to_be_visible()
    shown(page, bench)
    at.get_by_role("button", name="Export", exact=True).click()
    with at.context.expect_page(timeout=200_000) as opened:
        at.get_by_role("link", name="Open the report").click()
        expect(at.get_by_text("The report is computed")).to_be_visible()
    report = opened.value
    expect(report.get_by_role("heading", name="plate <b>&", level=1)).to_be_visible(timeout=200_000)
    expect(report.get_by_role("cell", name="Room <7> & 8", exact=True)).to_be_visible()
    expect(report.get_by_role("cell", name="f/5.6", exact=True)).to_be_visible()
    # axe, and every size, see a report of the same form in test_page_job
    page.sound()


def test_pages_beside_the_page(page: Watched) -> None:
    at = page.page
    at.goto(f"{page.origin}/problems")
    expect(at.get_by_role("heading", level=1)).to_be_visible()
    auditor(at, axe_at=AXE_STYLES)("the list of problems")
