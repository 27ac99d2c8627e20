"""Lists of tests and analyses on the page: state, steps and picture of each; found by a word, gone on with, deleted."""

from __future__ import annotations

import re

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from stereorig.server.store.indexing.entries import analysis_entry
from tests.support import results_page
from tests.support.page_bench import Watched
from tests.support.results_page import API, Bench
from tests.support.service_rig import new_test

bench, page = results_page.bench, results_page.page  # fixtures

pytestmark = pytest.mark.timeout(500)
SLOW = 60_000


def interrupted(bench: Bench) -> str:
    """An analysis with the settings of the measured one that was ended before its first step, as a kill leaves it."""
    stored = bench.service.tests.analyses.read(bench.test_id, bench.analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "steps", "inputs", "software", "calibration_id")}
    document = bench.service.tests.analyses.create(bench.test_id, {**kept, "label": "cut short"})
    bench.service.catalog.put_entry("analysis", bench.test_id, document.id, analysis_entry(document))
    return document.id


def row_of(at: Page, analysis_id: str) -> Locator:
    return at.get_by_role("row").filter(has=at.locator(f'a[href$="{analysis_id}"]'))


@pytest.mark.parametrize("place", ["test", "results", "analysis", "tests"])
def test_an_interrupted_analysis_is_gone_on_with_where_it_is_listed(page: Watched, bench: Bench, place: str) -> None:
    stopped = interrupted(bench)
    at = page.open(
        {
            "test": f"#/test/{bench.test_id}?at=measure",
            "results": f"#/results/{bench.test_id}",
            "analysis": f"#/results/{bench.test_id}/{stopped}",
            "tests": "#/test",
        }[place]
    )
    where = {
        "test": row_of(at, stopped),
        "results": row_of(at, stopped),
        "analysis": at.locator('div[data-screen="results"]'),
        "tests": at.get_by_role("row").filter(has=at.locator(f'a[href="#/test/{bench.test_id}"]')),
    }[place]
    expect(where).to_contain_text("interrupted")
    with at.expect_response(lambda answer: answer.url.endswith(":continue")) as sent:
        where.get_by_role("button", name=re.compile("^Continue")).click()
    assert sent.value.status == 202
    expect(where.get_by_text(re.compile("succeeded|finished")).first).to_be_visible(timeout=SLOW)
    expect(where.get_by_role("button", name=re.compile("^Continue"))).to_have_count(0)
    for name in ("w_mm", "exx"):  # the same settings on the same images: the same numbers
        np.testing.assert_array_equal(bench.field(2, name, stopped), bench.field(2, name))
    page.sound()
    bench.client.delete(f"{API}/tests/{bench.test_id}/analyses/{stopped}").raise_for_status()


def test_the_tests_list_shows_steps_state_and_picture_finds_and_deletes(page: Watched, bench: Bench) -> None:
    spare = new_test(bench.client, name="Spare & empty", specimen="brass")
    at = page.open("#/test")
    measured = at.get_by_role("row").filter(has=at.locator(f'a[href="#/test/{bench.test_id}"]'))
    empty = at.get_by_role("row").filter(has=at.locator(f'a[href="#/test/{spare}"]'))
    cells = measured.get_by_role("cell")
    expect(cells.nth(3)).to_have_text("3")
    expect(cells.nth(0).locator("img")).to_have_js_property("complete", True)
    expect(empty.get_by_role("cell").nth(3)).to_have_text("0")
    expect(empty).to_contain_text("no steps")
    at.get_by_label("Find a test").fill("BRASS")
    expect(empty).to_be_visible()
    expect(measured).to_have_count(0)
    empty.get_by_role("button", name="Delete Spare & empty").click()
    at.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(empty).to_have_count(0)
    at.get_by_label("Find a test").fill("")
    expect(measured).to_be_visible()
    assert spare not in [one["id"] for one in bench.client.get(f"{API}/tests").json()["tests"]]
    page.sound()
