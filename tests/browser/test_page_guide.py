"""The page's guided acquisition in a browser: seen live, proposed, taken, finished."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.page_bench import Watched
from tests.support.service_rig import data_of
from tests.support.small_board_rig import SMALL_BOARD

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SLOW = 200_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL_BOARD), data_of(tmp_path_factory.mktemp("guide"))).start()
    yield made
    made.close()


def hold(client: httpx.Client, pose: list[float]) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "charuco", "params": {"pose": pose}}).raise_for_status()


def test_a_target_in_the_hand_is_seen_taken_and_fitted(page: Watched, client: httpx.Client) -> None:
    hold(client, [0.0] * 6)
    shown = page.open("#/calibrate")
    panel = shown.get_by_role("region", name="Guided acquisition")
    panel.get_by_label("Purpose").fill("by hand")
    panel.get_by_label("Goal").fill("-1")
    panel.get_by_role("button", name="Begin guided acquisition").click()
    expect(panel.get_by_role("alert")).to_have_text("Give more than 0\u00a0µm, not −1\u00a0µm.")
    panel.get_by_label("Goal").fill("")
    expect(panel.get_by_role("alert")).to_have_count(0)
    panel.get_by_role("button", name="Begin guided acquisition").click()
    # the first view is taken by itself, and the next proposed with its worth
    sentence = panel.locator('[data-role="proposal"]')
    expect(sentence).to_contain_text("the uncertainty of Z at your specimen goes from", timeout=SLOW)
    expect(panel.locator('[data-role="outline"]')).to_have_count(2, timeout=SLOW)
    expect(panel.locator('[data-role="wanted"]')).to_have_count(2)
    expect(panel.locator('[data-role="seen-cam1"]')).to_contain_text("like view 1", timeout=SLOW)
    holder = client.get(f"{API}/rig").json()["holder"]
    calibration = client.get(f"{API}/jobs/{holder['job_id']}").json()["subject"]["calibration_id"]
    for count in range(1, 4):
        guide = client.get(f"{API}/calibrations/{calibration}/guide").json()
        assert guide["guidance"]["taken"] == count
        hold(client, guide["guidance"]["proposal"]["pose"])
        expect(panel.locator('[data-role="uncertainty"]')).to_contain_text(f"{count + 1} views", timeout=SLOW)
    if os.environ.get("STEREORIG_PICTURES"):
        panel.screenshot(path=str(Path(os.environ["STEREORIG_PICTURES"]) / "guide.png"))
    cells = panel.get_by_role("table", name="Points seen in each part of cam1's image")
    covered = client.get(f"{API}/calibrations/{calibration}/guide").json()["guidance"]["coverage"]["cells"]["cam1"]
    assert [c for c in cells.inner_text().split() if c] == [str(n) for row in covered for n in row if n]
    panel.get_by_role("button", name="Finish and fit").click()
    expect(shown.get_by_role("region", name="Verdict")).to_contain_text("by hand", timeout=SLOW)
    assert client.get(f"{API}/calibrations/{calibration}").json()["plan"]["kind"] == "guided"
    page.sound()
