"""The page's calibrations in a browser: foreseen, run, seen, refused, cut short, compared, decided on."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Download, Page, expect

from stereorig.core.boards import BoardTarget
from stereorig.core.names import CameraName
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.board_views import camera_pair, hand_poses, render_views, write_views
from tests.support.page_bench import Watched, watched
from tests.support.service_rig import SMALL, wait_for_job, wait_for_rig

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SLOW = 200_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("calibrate") / "data").start()
    yield made
    made.close()


def newest(client: httpx.Client) -> str:
    return str(client.get(f"{API}/calibrations").json()["calibrations"][-1]["id"])


def begin(shown: Page) -> None:
    shown.get_by_role("button", name="Calibrate", exact=True).click()


def test_foreseen_run_and_seen(page: Watched, client: httpx.Client) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "grid"}).raise_for_status()
    shown = page.open("#/calibrate")
    reply = client.post(f"{API}/calibrations:expect", json={}).json()
    expected = shown.locator('[data-role="expected"]')
    # the same figures as the API's, before anything is begun
    expect(expected).to_contain_text("middle of the volume")
    z_um = 1000 * reply["points"][0]["sigma_mm"][2]
    cell = expected.locator("tbody tr").first.locator("td").last
    assert float(cell.inner_text().split()[0]) == pytest.approx(z_um, rel=0.01)
    shown.get_by_label("Fitted positions").fill("0, 0.05")
    expect(expected).to_contain_text("would be refused", timeout=SLOW)
    # what cannot be is said beside its field, and not sent
    fields = {name: shown.locator(".field", has=shown.get_by_label(name)) for name in ("Fitted", "Held-out")}
    for text, told in (("0, x", "“x” is no number"), ("0, 50", "50\u00a0mm is beyond it"), ("0", "there is one")):
        shown.get_by_label("Fitted positions").fill(text)
        expect(fields["Fitted"].get_by_role("alert")).to_contain_text(told)
        begin(shown)
        expect(shown.get_by_label("Fitted positions")).to_be_focused()
    shown.get_by_label("Fitted positions").fill("0, 5")
    expect(fields["Fitted"].get_by_role("alert")).to_have_count(0)
    shown.get_by_label("Held-out positions").fill("5")
    expect(fields["Held-out"].get_by_role("alert")).to_contain_text("is a fitted position too")
    assert client.get(f"{API}/calibrations").json()["calibrations"] == []
    shown.get_by_label("Held-out positions").fill("2")
    shown.get_by_label("Frames averaged").fill("4")
    shown.get_by_label("Label", exact=True).first.fill("morning")
    begin(shown)
    expect(shown.get_by_label("Progress of the calibration")).to_be_visible()
    expect(shown.get_by_role("region", name="Verdict")).to_contain_text("morning", timeout=SLOW)
    document = client.get(f"{API}/calibrations/{newest(client)}").json()
    assert document["plan"]["held_out_mm"] == [2.0]
    verdict = shown.get_by_role("region", name="Verdict")
    for reason in document["verdict"]["reasons"]:
        expect(verdict).to_contain_text(reason)
    expect(shown.get_by_text(f"{document['checks']['held_out']['rbe_px']:.5f} px").first).to_be_visible()
    # one figure of the parameters, with its uncertainty
    expect(shown.get_by_role("region", name="Parameters of each camera")).to_contain_text(
        f"{document['cam1']['z0_mm']:.2f}"
    )
    # the estimate is confirmed: the simulated grid is on its corner
    noise = sum(document["noise_px"].values()) / 2
    reply = client.post(f"{API}/calibrations:expect", json={"positions_mm": [0, 5], "noise_px": noise}).json()
    assert reply["assumed"]["roll_deg"] == pytest.approx(45.0, abs=1.5)
    for name, sigma in document["sigma"].items():
        assert 0.5 < reply["parameters"][name]["sigma"] / sigma < 2.0, name
    assert reply["shape_rms_mm"] == pytest.approx(document["uncertainty"]["shape_rms_mm"], rel=0.5)
    # the crosses lie where the intersections were found, in the pixels of the picture that is shown
    residuals = client.get(f"{API}/calibrations/{document['id']}/residuals").json()["views"]
    image = shown.get_by_alt_text("Calibration view of cam2")
    shown.wait_for_function("image => image.naturalWidth === 256", arg=image.element_handle())
    shown.get_by_label("Position", exact=True).select_option(index=1)  # 2 mm, held out
    found = next(v for v in residuals if v["camera"] == "cam2" and v["held_out"])
    path = shown.locator('.view [data-role="nodes"]').nth(1)
    expect(path).to_have_count(1)
    drawn = [tuple(map(float, xy)) for xy in re.findall(r"M([-\d.]+) ([-\d.]+)h", path.get_attribute("d") or "")]
    wanted = [tuple(xy) for row in found["found_px"] for xy in row]
    assert len(drawn) == 81
    assert np.abs(np.array(drawn) - wanted).max() < 1e-6
    box = path.evaluate(
        "path => { const b = path.getBBox(), m = path.getScreenCTM();"
        "return [b.x * m.a + m.e, b.y * m.d + m.f, (b.x + b.width) * m.a + m.e, (b.y + b.height) * m.d + m.f] }"
    )
    frame = image.bounding_box()
    assert frame is not None
    for k, (low, size, pixels) in enumerate(((frame["x"], frame["width"], 256), (frame["y"], frame["height"], 240))):
        values = [xy[k] for xy in wanted]
        assert box[k] == pytest.approx(low + (min(values) + 0.5) / pixels * size, abs=1)
        assert box[k + 2] == pytest.approx(low + (max(values) + 0.5) / pixels * size, abs=1)
    # ten times the magnification, ten times the arrow
    arrows = shown.locator('.view [data-role="arrows"]').nth(1)
    slider = shown.get_by_label("Magnification of the residual arrows")

    def first_arrow() -> float:
        arrow = re.search(r"l([-\d.e]+) ([-\d.e]+)", arrows.get_attribute("d") or "")
        assert arrow is not None
        return float(arrow[1])

    slider.fill("2")
    before = first_arrow()
    assert before == pytest.approx(100 * found["residual_px"][0][0][0], rel=1e-6)
    slider.fill("3")
    assert first_arrow() == pytest.approx(10 * before, rel=1e-6)
    # a mark that is not in the image is told beside it, before anything is sent
    shown.get_by_text("Known distance", exact=True).first.click()
    marks = shown.get_by_role("group", name="Marks in cam2, px")
    first = shown.get_by_label("cam2, mark 1, x")
    for text, told in (("256", "not 256\u00a0px"), ("-1", "not \N{MINUS SIGN}1\u00a0px")):
        first.fill(text)
        first.press("Tab")
        expect(marks.get_by_role("alert")).to_have_text(
            f"Mark 1, x, is not in the image. Give 0 to 255\u00a0px, {told}."
        )
    first.fill("255")
    expect(marks.get_by_role("alert")).not_to_contain_text("not in the image")
    page.sound()


def test_a_scene_without_a_grid_is_refused_with_cause_and_remedy(page: Watched, client: httpx.Client) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "steel"}).raise_for_status()
    shown = page.open("#/calibrate")
    try:
        begin(shown)
        progress = shown.locator('[data-role="progress"]')
        expect(progress.locator(".problem")).to_be_visible(timeout=SLOW)
        problem = client.get(f"{API}/calibrations/{newest(client)}").json()["problem"]
        expect(progress).to_contain_text(problem["detail"])
        expect(progress).to_contain_text(problem["remedy"])
        expect(progress).to_contain_text(problem["code"])
        # and it is in the list as what it is
        expect(shown.locator("tr", has_text=newest(client))).to_contain_text("failed")
    finally:
        client.put(f"{API}/sim/scene", json={"scene": "grid"}).raise_for_status()
    page.sound()


@pytest.mark.fault(34)
def test_what_a_verdict_refused_is_shown_with_its_reasons(
    page: Watched, client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = service.rig._devices.world
    assert world is not None
    expose = world.expose

    # camera 2 is pushed while it is at 2 mm
    def leant_on(cam: CameraName, **how: Any) -> Any:
        image = expose(cam, **how)
        return np.roll(image, 1, axis=1) if cam == "cam2" and abs(world._position_mm(2) - 2.0) < 0.2 else image

    monkeypatch.setattr(world, "expose", leant_on)
    shown = page.open("#/calibrate")
    shown.get_by_label("Fitted positions").fill("0, 5")
    shown.get_by_label("Held-out positions").fill("2")
    begin(shown)
    progress = shown.locator('[data-role="progress"]')
    expect(progress.locator(".problem")).to_contain_text("calibration_rejected", timeout=SLOW)
    refused = newest(client)
    document = client.get(f"{API}/calibrations/{refused}").json()
    assert (document["state"], document["verdict"]["level"]) == ("failed", "failed")
    assert document["checks"]["held_out"]["rbe_px"] > 10 * document["checks"]["fitted"]["rbe_px"]
    verdict = shown.get_by_role("region", name="Verdict")
    assert len(document["verdict"]["reasons"]) >= 1
    for reason in document["verdict"]["reasons"]:
        expect(verdict).to_contain_text(reason)
    expect(verdict).to_contain_text(document["problem"]["remedy"])
    # which view it was is seen: its arrows are the long ones
    views = client.get(f"{API}/calibrations/{refused}/residuals").json()["views"]
    worst = max(views, key=lambda view: float(view["rbe_px"]))
    assert (worst["camera"], worst["held_out"]) == ("cam2", True)
    shown.get_by_label("Position", exact=True).select_option(index=1)
    expect(shown.get_by_text(re.compile(r"held out, dZ .*; RBE (1\.0|0\.99)\d*\spx"))).to_be_visible()
    arrows = shown.locator('.view [data-role="arrows"]')
    expect(arrows).to_have_count(2)
    # long, and yet in the picture
    found = re.search(r"l([-\d.e]+) ([-\d.e]+)", arrows.nth(1).get_attribute("d") or "")
    assert found is not None
    assert 25 < np.hypot(float(found[1]), float(found[2])) < 60
    # it is there to be looked at, and for nothing else
    expect(verdict.get_by_role("button", name="Accept", exact=True)).to_have_count(0)
    expect(shown.get_by_label(f"Compare {refused}")).to_be_disabled()
    for answer in (
        client.get(f"{API}/calibrations/{refused}/file"),
        client.post(f"{API}/tests", json={"name": "hasty", "calibration_id": refused}),
    ):
        assert (answer.status_code, answer.json()["code"]) == (409, "calibration_not_complete"), answer.text
    answer = client.put(f"{API}/calibrations/{refused}/review", json={"decision": "accepted"})
    assert answer.status_code == 409
    page.sound()


def test_cancel_and_a_camera_lost_in_mid_run_are_shown(page: Watched, client: httpx.Client, service: Service) -> None:
    shown = page.open("#/calibrate")
    begin(shown)
    shown.get_by_role("button", name="Cancel").click()
    progress = shown.locator('[data-role="progress"]')
    expect(progress).to_contain_text("cancelled", timeout=SLOW)
    begin(shown)
    expect(progress).to_contain_text("taking views", timeout=SLOW)
    service.rig.pair.units["cam2"].grabber.faults.gone = True  # type: ignore[attr-defined]
    expect(progress.locator(".problem")).to_contain_text("cam2", timeout=SLOW)
    expect(progress).to_contain_text("camera_lost")
    job = wait_for_job(client, client.post(f"{API}/rig:reconnect").json()["job"])
    assert job["state"] == "succeeded"
    wait_for_rig(client)
    page.sound()


def test_import_compare_accept_discard(page: Watched, client: httpx.Client, tmp_path: Path) -> None:
    made = next(c for c in client.get(f"{API}/calibrations").json()["calibrations"] if c["state"] == "complete")
    document = client.get(f"{API}/calibrations/{made['id']}/file").json()
    document["cam1"]["z0_mm"] += 10 * document["sigma"]["cam1.z0_mm"] * 2**0.5
    file = tmp_path / "other.json"
    file.write_text(json.dumps(document), encoding="utf-8")
    shown = page.open("#/calibrate")
    shown.get_by_text("Import a calibration").click()
    shown.get_by_label("File").set_input_files(file)
    shown.get_by_role("button", name="Import", exact=True).click()
    expect(shown.get_by_text("is imported")).to_be_visible()
    other = newest(client)
    for one in (made["id"], other):
        shown.get_by_label(f"Compare {one}").check()
    shown.get_by_role("button", name="Compare the two chosen").click()
    dialog = shown.get_by_role("dialog")
    row = dialog.locator("tr", has_text="cam1 z0")
    assert float(row.locator("td").last.inner_text().replace("−", "-")) == pytest.approx(
        -10.0, abs=0.2
    )  # the list is newest first
    dialog.get_by_role("button", name="Close").click()

    shown.get_by_role("button", name="Accept", exact=True).click()
    shown.get_by_role("dialog").get_by_role("button", name="This rig").click()
    verdict = shown.get_by_role("region", name="Verdict")
    expect(verdict.locator(".badge").first).to_have_text("accepted")
    expect(verdict.get_by_role("link", name="Make a test")).to_have_attribute("href", "#/test?new")
    geometry = client.get(f"{API}/calibrations/{other}/geometry").json()
    expect(verdict).to_contain_text(f"{geometry['stereo_angle_deg']:.2f}")
    assert client.get(f"{API}/calibrations/{other}").json()["review"]["decision"] == "accepted"
    # a new test measures with it unless another one is chosen
    shown.get_by_role("link", name="Test", exact=True).click()
    expect(shown.get_by_label("Calibration", exact=True)).to_have_value(other)
    shown.go_back()
    shown.get_by_role("link", name="other.json").click()
    shown.get_by_role("button", name="Discard", exact=True).click()
    shown.get_by_label("Reason").fill("a trial")
    shown.get_by_role("dialog").get_by_role("button", name="Discard").click()
    expect(shown.get_by_role("region", name="Verdict")).to_contain_text("discarded by local: a trial")
    shown.get_by_role("button", name="Delete …").click()
    shown.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(shown.get_by_role("link", name="other.json")).to_have_count(0)
    assert client.get(f"{API}/calibrations/{other}").status_code == 404
    page.sound()


def test_on_a_tablet_nothing_hangs_over(chromium: Browser, client: httpx.Client) -> None:
    with watched(chromium, str(client.base_url).rstrip("/"), viewport={"width": 820, "height": 1180}) as page:
        shown = page.open("#/calibrate")
        shown.wait_for_selector(".view")
        assert not shown.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth")
        page.sound()


def test_targets_are_printed_and_measured_on_the_page(page: Watched, client: httpx.Client, tmp_path: Path) -> None:
    shown = page.open("#/calibrate")
    shown.get_by_text("Print a target or speckle").click()
    saved: dict[str, bytes] = {}

    def keep(download: Download) -> None:
        saved[download.suggested_filename] = Path(download.path()).read_bytes()

    shown.on("download", keep)
    with shown.expect_event("download", lambda one: one.suggested_filename == "target.toml"):
        shown.get_by_role("button", name="Save the rig's target").click()
    assert saved["target.pdf"].startswith(b"%PDF")
    rigs = parse_config(SMALL).target.pitch_mm
    assert f"pitch_mm = {rigs:.1f}" in saved["target.toml"].decode()
    shown.get_by_label("Speckle, diameter").fill("1")
    with shown.expect_download() as speckle:
        shown.get_by_role("button", name="Save speckle").click()
    answer = client.get(f"{API}/prints/speckle", params={"diameter_mm": 1.0})
    assert Path(speckle.value.path()).read_bytes() == answer.content
    kept = tmp_path / "target.toml"
    kept.write_bytes(saved["target.toml"])
    shown.get_by_label("target.toml of the print").set_input_files(kept)
    numbers = {"across, by its numbers": "100", "across, measured": "99.93"}
    numbers |= {"down, by its numbers": "200", "down, measured": "200.4"}
    for label, number in numbers.items():
        shown.get_by_label(f"Ruler {label}").fill(number)
    shown.get_by_label("u of a measured length").fill("0.05")
    with shown.expect_download() as measured:
        shown.get_by_role("button", name="Save the measured target").click()
    # by hand: the mean of 0.9993 and 1.002, and of 0.05/100 and 0.05/200
    expect(shown.locator('[data-role="print-scale"]')).to_contain_text("scale 1.00065 ± 0.00038")
    assert f"pitch_mm = {rigs * 1.00065:.9g}" in Path(measured.value.path()).read_text(encoding="utf-8")


def test_images_at_hand_are_calibrated_from_and_fitted_again_without_a_view(
    page: Watched, client: httpx.Client, tmp_path: Path
) -> None:
    target, size = BoardTarget(kind="checkerboard", size=(11, 8), pitch_mm=4.0), (612, 512)
    cameras = camera_pair(focal_px=1000.0, size_px=size)
    views = render_views(target, hand_poses(target, cameras, range(9), size_px=size), cameras, size_px=size)
    folder = write_views(tmp_path / "views", views, target, cameras, nominal=False)
    shown = page.open("#/calibrate")
    panel = shown.get_by_role("region", name="Calibrate from images")
    panel.locator("summary").click()
    for n in (1, 2):
        panel.get_by_label(f"Camera {n}'s images").set_input_files(sorted(folder.glob(f"cam{n}_*.tif")))
    expect(panel.locator('[data-role="pairs"]')).to_contain_text("9 pairs")
    start = panel.get_by_role("button", name="Calibrate from these images")
    start.click()  # what is missing is said, and nothing is sent
    expect(panel.get_by_role("alert").first).to_be_visible()
    for label, value in (
        ("Points or lines across", "11"),
        ("Points or lines down", "8"),
        ("Distance of points or lines", "4"),
        ("Focal length", "10"),
        ("Width of a pixel", "10"),
        ("Name it", "own images"),
    ):
        panel.get_by_label(label).fill(value)
    start.click()
    verdict = shown.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text("own images", timeout=SLOW)
    first = newest(client)
    assert client.get(f"{API}/calibrations/{first}").json()["plan"]["label"] == "own images"
    expect(start).to_be_enabled(timeout=SLOW)  # what is shown is drawn a last time
    # both images of a ticked pair are left out, and the first calibration is kept
    shown.get_by_text("Each view", exact=True).click()
    shown.get_by_role("checkbox", name=re.compile("^Leave out 002_cam1")).check()
    shown.get_by_role("button", name="Fit again without the ticked views").click()
    expect(verdict).to_contain_text("own images without 2", timeout=SLOW)
    second = client.get(f"{API}/calibrations/{newest(client)}").json()
    assert second["id"] != first
    assert {view["index"] for view in second["taken"]} == set(range(9)) - {2}
    page.sound()
