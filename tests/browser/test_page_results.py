"""The page's results in a browser: colours against values, numbers against the API's, nothing over a cut."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from core.cameras.camera import Camera
from server.exports.mesh import triangles_of
from server.formats.calibrations.recognise import load_calibration
from server.formats.results.reading import read_field, read_head
from server.formats.results.writing import Provenance, write_field
from server.report.source import find_source
from server.store.index import analysis_entry
from tests.support import results_page
from tests.support.page_bench import UNREACHED, Watched, tabbed, watched
from tests.support.results_page import API, ENDS, LINE, Bench, drawn, given, shown, with_a_cut

bench, page = results_page.bench, results_page.page  # fixtures

pytestmark = pytest.mark.timeout(600)
expect.set_options(timeout=30_000)  # the machine may be busy

# matplotlib's own numbers at 0, 1/4, 1/2, 3/4 and 1, its documentation's viridis
VIRIDIS = {0.0: (68, 1, 84), 0.25: (59, 82, 139), 0.5: (33, 145, 140), 0.75: (94, 201, 98), 1.0: (253, 231, 37)}


def pixel(at: Page, x: int, y: int) -> list[int]:
    """A pixel of the canvas."""
    return list(
        at.evaluate(
            "at => { const map = document.querySelector('canvas[data-role=map]').getContext('2d');"
            " return [...map.getImageData(...at, 1, 1).data] }",
            [x, y],
        )
    )


def limits(at: Page) -> tuple[float, float]:
    bar = at.locator('[data-role="colourbar"]').first
    return float(bar.get_attribute("data-low") or "nan"), float(bar.get_attribute("data-high") or "nan")


def viridis(share: float) -> Any:
    known = sorted(VIRIDIS)
    return np.array([np.interp(share, known, [VIRIDIS[k][c] for k in known]) for c in range(3)])


def point_on_screen(at: Page, x: float, y: float) -> tuple[float, float]:
    """Where a pixel of the picture lies in the window, by the transform that the browser drew it with."""
    box = at.locator('canvas[data-role="map"]').evaluate(
        "c => { const b = c.getBoundingClientRect(); return [b.left, b.top, b.width, b.height] }"
    )
    return box[0] + (x + 0.5) / 256 * box[2], box[1] + (y + 0.5) / 240 * box[3]


def test_colours_are_the_values_through_the_map_at_any_zoom(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    w, x, y = (bench.field(2, name) for name in ("w_mm", "x_px", "y_px"))
    low, high = limits(at)
    assert (low, high) == pytest.approx(tuple(np.nanpercentile(w, [1, 99])), rel=1e-6)
    for r, c in ((2, 3), (5, 6), (9, 10), (0, 0)):
        share = min(max((w[r, c] - low) / (high - low), 0.0), 1.0)
        got = pixel(at, round(x[r, c]), round(y[r, c]))
        assert got[3] == 255
        # fixed points 1/4 apart, straight between: near where the map is bent the colour is a little off
        assert np.abs(np.array(got[:3]) - viridis(share)).max() < 18
    middle = (w[5, 6] + w[5, 7] + w[6, 6] + w[6, 7]) / 4
    share = (middle - low) / (high - low)
    assert np.abs(np.array(pixel(at, round(x[5, 6] + 5), round(y[5, 6] + 5))[:3]) - viridis(share)).max() < 18
    assert pixel(at, 20, 20)[3] == 0  # outside the region
    # on the screen, the colour lies where the pixel is, at two zooms
    at.get_by_label("Opacity", exact=True).fill("100")
    for scale in ("fit", "in"):
        if scale == "in":
            frame = at.locator(".view .frame").first
            frame.focus()
            for _ in range(4):
                at.keyboard.press("+")
        sx, sy = point_on_screen(at, x[5, 6], y[5, 6])
        wanted = pixel(at, round(x[5, 6]), round(y[5, 6]))[:3]
        seen = at.screenshot(clip={"x": int(sx), "y": int(sy), "width": 1, "height": 1})
        assert np.abs(picture(seen)[0, 0, :3].astype(int) - wanted).max() <= 3
    page.sound()


def picture(data: bytes) -> Any:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_nothing_is_drawn_over_a_missing_point_or_a_cut(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, analysis_id=bench.cut_id)
    x, y = bench.field(2, "x_px", bench.cut_id), bench.field(2, "y_px", bench.cut_id)
    for r, c in ((4, 5), (4, 6), (8, 2)):
        assert pixel(at, round(x[r, c]), round(y[r, c]))[3] == 0
    # between the two missing ones, too; on their good neighbours there is colour
    assert pixel(at, round(x[4, 5]) + 5, round(y[4, 5]))[3] == 0
    assert pixel(at, round(x[4, 4]), round(y[4, 4]))[3] == 255
    # the three corners left of a cell whose fourth is missing carry their half of it
    assert pixel(at, round(x[7, 1]) + 2, round(y[7, 1]) + 2)[3] == 255
    assert pixel(at, round(x[7, 1]) + 8, round(y[7, 1]) + 8)[3] == 0
    # the cut at column 155 between points at 150 and 160: nothing from one side reaches to the other
    row = round(y[2, 9])
    assert (x[2, 9], x[2, 10]) == (150, 160)
    assert [pixel(at, column, row + 5)[3] for column in (149, 152, 155, 158, 161)] == [255, 0, 0, 0, 255]
    # below its end the field is whole
    assert pixel(at, 155, round(y[9, 9]) + 5)[3] == 255
    page.sound()


def test_what_is_under_the_mouse_is_the_probes(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    readout = at.locator(".view .readout").first
    for spot in ((103.4, 98.2), (141.0, 131.0)):
        reply = bench.client.get(
            f"{bench.path()}/probe", params={"x_px": spot[0], "y_px": spot[1], "step": 2, "frame": "specimen"}
        ).json()
        at.mouse.move(*point_on_screen(at, *spot))
        w = reply["values"]["w_mm"]["value"]
        expect(readout).to_have_attribute("data-value", repr(w))
        text = f"{w:.5g}".replace("-", "\N{MINUS SIGN}")[:7]
        expect(readout).to_contain_text(text)
        expect(readout).to_contain_text("±")
    at.mouse.click(*point_on_screen(at, 103.4, 98.2))
    reply = bench.client.get(
        f"{bench.path()}/probe", params={"x_px": 103.4, "y_px": 98.2, "step": 2, "frame": "specimen"}
    ).json()
    pinned = at.locator('[data-role="probe"]')
    expect(pinned).to_contain_text(f"row {reply['row']}, column {reply['col']}, step 2")
    row = pinned.locator("tr", has=at.get_by_role("cell", name="w_mm", exact=True))
    expect(row).to_contain_text(f"{reply['values']['w_mm']['value']:.5f}".replace("-", "\N{MINUS SIGN}")[:7])
    page.sound()


def test_the_interval_is_chosen_and_a_click_shows_the_budget(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    spot = (103.4, 98.2)
    query = {"x_px": spot[0], "y_px": spot[1], "step": 2, "coverage": 0.95}
    w = bench.client.get(f"{bench.path()}/probe", params=query).json()["values"]["w_mm"]
    readout, says = at.locator(".view .readout").first, at.locator('[data-role="includes"]')
    expect(says).to_contain_text("u (k = 1) includes matching, reference, calibration")
    at.mouse.move(*point_on_screen(at, *spot))
    expect(readout).to_contain_text(f"± {w['sigma']:.2g}")
    expect(readout).to_contain_text("u, k = 1")
    at.get_by_label("Uncertainties shown").select_option("95 %")
    expect(says).to_contain_text("U (k = 1.96, 95 %) includes")
    at.mouse.move(*point_on_screen(at, spot[0] + 0.2, spot[1]))
    expect(readout).to_contain_text(f"± {w['expanded']:.2g}")
    at.mouse.click(*point_on_screen(at, *spot))
    row = at.locator('[data-role="probe"] tr', has=at.get_by_role("cell", name="w_mm", exact=True)).first
    budget = row.locator('[data-role="budget"]')
    expect(budget).to_be_hidden()
    row.get_by_role("button").click()
    expect(budget).to_be_visible()
    for cause, part in w["budget"].items():
        expect(budget.locator("tr", has_text=cause)).to_contain_text(f"{100 * part**2 / w['sigma'] ** 2:.2g}"[:3])
    page.sound()


def test_numbers_without_the_calibrations_uncertainty_say_so(page: Watched, bench: Bench) -> None:
    whole = bench.service.tests.analysis_path(bench.test_id, bench.analysis_id)
    stored = bench.service.tests.analysis(bench.test_id, bench.analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "steps", "inputs", "software")}
    document = bench.service.tests.create_analysis(bench.test_id, {**kept, "label": "as imported"})
    bench.service.catalog.put_entry("analysis", bench.test_id, document.id, analysis_entry(document))
    folder = bench.service.tests.analysis_path(bench.test_id, document.id)
    for n in stored["steps"]:
        field = replace(read_field(whole / f"step_{n:04d}.nc"), common=None, causes=None)
        write_field(
            folder / f"step_{n:04d}.nc", field, Provenance({"subset_px": 25, "spacing_px": 10}, {}, "0", step=n)
        )
    at = shown(page, bench, analysis_id=document.id)
    lacking = "calibration not included"
    expect(at.locator('[data-role="includes"] .badge')).to_have_text(lacking)
    at.mouse.move(*point_on_screen(at, 103.4, 98.2))
    expect(at.locator(".view .readout").first).to_contain_text(lacking)
    at.mouse.click(*point_on_screen(at, 103.4, 98.2))
    expect(at.locator('[data-role="probe"] table caption').first).to_contain_text(lacking)
    at.locator("summary", has_text="Extensometers").click()
    given(at, ENDS, (80, 90, 160, 90))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    expect(at.get_by_text(f"± u (k = 1) includes matching only; {lacking}")).to_be_visible()
    page.sound()


def test_steps_scales_and_images_are_chosen(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Step before").click()
    drawn(at, "1 w_mm reference")
    assert "step=1" in at.url
    alone = limits(at)
    at.get_by_label("Over", exact=True).select_option("all")
    lowest = min(np.percentile(bench.field(n, "w_mm"), 1) for n in (1, 2))
    at.wait_for_function(
        "low => Math.abs(document.querySelector('[data-role=colourbar]').dataset.low - low) < 1e-9", arg=lowest
    )
    assert limits(at)[0] < alone[0]
    at.get_by_label("Limits", exact=True).select_option("given")
    at.get_by_label("Lower limit").fill("-0.05")
    at.get_by_label("Upper limit").fill("0")
    at.get_by_label("Upper limit").press("Tab")
    at.wait_for_function("() => document.querySelector('[data-role=colourbar]').dataset.high === '0'")
    assert limits(at) == (-0.05, 0.0)
    # the step's own images: the points lie where the calibration puts them
    for cam in ("cam1", "cam2"):
        at.get_by_label("Image", exact=True).select_option(cam)
        drawn(at, f"1 w_mm {cam}")
        positions = np.array(bench.client.get(f"{bench.path()}/steps/1/positions/{cam}").json()["values"], dtype=float)
        x, y = positions[5, 6]
        assert pixel(at, round(x), round(y))[3] == 255
    at.get_by_label("Image", exact=True).select_option("reference")
    # a reference has no displacement, and a message states so
    at.get_by_role("button", name="Step before").click()
    expect(at.get_by_text("it is the reference of the displacements")).to_be_visible()
    at.get_by_role("button", name="Next step").click()
    drawn(at, "1 w_mm reference")
    for name in ("exx", "zncc:0", "epipolar_px", "sigma_w_mm", "status", "x_mm"):
        at.get_by_label("Field", exact=True).select_option(name)
        drawn(at, f"1 {name} reference")
    page.sound()


def test_places_are_those_of_the_images(bench: Bench) -> None:
    """Camera 1 sees the reference's points where they were put, and camera 2 by its own pinhole formula."""
    calibration = load_calibration(bench.service.tests.calibration_file(bench.test_id))
    expected = {
        cam: np.array(bench.client.get(f"{bench.path()}/steps/0/positions/{cam}").json()["values"], dtype=float)
        for cam in ("cam1", "cam2")
    }
    x, y = bench.field(0, "x_px"), bench.field(0, "y_px")
    assert np.abs(expected["cam1"] - np.stack([x, y], axis=-1)).max() < 0.1
    xyz = np.stack([bench.field(0, f"{a}_mm", frame="system") for a in "xyz"], axis=-1)
    camera: Camera = calibration.pair.cam2
    p = xyz @ camera.cam_from_sys.rotation.T + camera.cam_from_sys.translation_mm
    content = json.loads(bench.service.tests.calibration_file(bench.test_id).read_text())["cam2"]
    # Eqs. (5) to (8): the ideal image point, then Seidel's radial distortion
    ideal = content["phd_px"] * p[..., :2] / p[..., 2:]
    r2 = (expected["cam2"][..., 0] - content["cx_px"]) ** 2 + (
        (expected["cam2"][..., 1] - content["cy_px"]) / content["aspect"]
    ) ** 2
    seen = np.stack(
        [
            (expected["cam2"][..., 0] - content["cx_px"]),
            (expected["cam2"][..., 1] - content["cy_px"]) / content["aspect"],
        ],
        axis=-1,
    )
    assert np.abs(seen - ideal).max() < 0.2 + np.abs(content["kappa_per_px2"] * r2[..., None] * ideal).max()
    missing = bench.client.get(f"{bench.path(bench.cut_id)}/steps/1/positions/cam1").json()["values"]
    assert missing[4][5] == [None, None]
    assert bench.client.get(f"{bench.path()}/steps/1/positions/cam3").status_code == 422


def drag(at: Page, a: tuple[float, float], b: tuple[float, float]) -> None:
    (x0, y0), (x1, y1) = point_on_screen(at, *a), point_on_screen(at, *b)
    at.mouse.move(x0, y0)
    at.mouse.down()
    at.mouse.move((x0 + x1) / 2, (y0 + y1) / 2)
    at.mouse.move(x1, y1)
    at.mouse.up()


def answer_of(at: Page, role: str) -> Any:
    chart = at.locator(f'[data-role="{role}"]')
    expect(chart).to_have_attribute("data-answer", re.compile(".+"))
    return json.loads(chart.get_attribute("data-answer") or "")


def wait_for_chart(at: Page, role: str, condition: str, arg: Any = None) -> None:
    """Wait until what a chart shows fulfils a condition on ``a``, its answer, and ``arg``."""
    answer = f"const a = JSON.parse(document.querySelector('[data-role={role}]').dataset.answer)"
    at.wait_for_function(f"arg => {{ {answer}; return {condition} }}", arg=arg)


def test_a_line_reads_what_the_gauges_read(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Line", exact=True).click()
    drag(at, (75, 80), (165, 140))
    got = answer_of(at, "line-chart")
    ends = [float(at.get_by_label(name, exact=True).input_value()) for name in LINE]
    assert ends == pytest.approx([75, 80, 165, 140], abs=0.6)
    body = {
        "lines": [{"vertices_px": [ends[:2], ends[2:]]}],
        "variables": ["w_mm", "x_mm", "y_mm", "z_mm"],
        "steps": [2],
    }
    reply = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body).json()["steps"][0]["lines"][0][
        "values"
    ]
    assert got["value"] == reply["w_mm"]["value"]
    assert got["sigma"] == reply["w_mm"]["sigma"]
    xyz = np.array([reply[f"{a}_mm"]["value"] for a in "xyz"], dtype=float)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz, axis=1), axis=0))])
    assert got["x"] == pytest.approx(length, abs=1e-9)
    expect(at.locator('[data-role="line-chart"] canvas')).to_be_visible()
    # another step: the same line
    at.get_by_role("button", name="Step before").click()
    drawn(at, "1 w_mm reference")
    reply = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body | {"steps": [1]}).json()["steps"][0][
        "lines"
    ][0]
    first = reply["values"]["w_mm"]["value"][0]
    wait_for_chart(at, "line-chart", "a.value[0] === arg", first)
    page.sound()


def test_extensometers_by_two_clicks_and_by_keyboard_against_load_and_channels(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Extensometer", exact=True).click()
    for spot in ((80, 90), (160, 90)):
        at.mouse.click(*point_on_screen(at, *spot))
    answer_of(at, "extensometer-chart")
    given(at, ENDS, (120, 70, 120, 160))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    expect(at.get_by_role("button", name="Remove e2")).to_be_visible()
    at.get_by_label("Against", exact=True).select_option("load")
    at.get_by_label("Show", exact=True).select_option("elongation_mm")
    wait_for_chart(at, "extensometer-chart", "a.x[1] === 689 && a.value[1].length === 2")
    got = answer_of(at, "extensometer-chart")
    body = {"extensometers": [{"a_px": [120, 70], "b_px": [120, 160]}]}
    steps = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body).json()["steps"]
    listed = [one["extensometers"][0]["values"]["elongation_mm"] for one in steps]
    assert [v[1] for v in got["value"]] == [one["value"] for one in listed]
    assert [v[1] for v in got["sigma"]] == [one["sigma"] for one in listed]
    assert got["x"] == [0.0, 689.0, 1378.0]
    at.get_by_label("Against", exact=True).select_option("channel:stroke_mm")
    wait_for_chart(at, "extensometer-chart", "a.x[2] === 6.89")
    at.get_by_role("button", name="Remove e1").click()
    expect(at.get_by_role("button", name="Remove e1")).to_have_count(0)
    # ends outside the field are refused with cause and remedy
    given(at, ENDS, (1, 1, 120, 160))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    expect(at.get_by_role("alert").filter(has_text="lies outside the field")).to_be_visible()
    page.sound(422)


def test_the_grey_level_under_the_mouse_is_that_of_the_picture_shown(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    readout = at.locator(".view .readout").first
    frame = at.locator(".view .frame").first
    for image, of in (("reference", (0, "cam1")), ("cam1", (2, "cam1")), ("cam2", (2, "cam2"))):
        at.get_by_label("Image", exact=True).select_option(image)
        drawn(at, f"2 w_mm {image}")
        stored_answer = bench.client.get(f"{API}/tests/{bench.test_id}/steps/{of[0]}/{of[1]}", params={"format": "png"})
        stored = np.asarray(Image.open(io.BytesIO(stored_answer.content)))
        # inside the field, and beside it, where there is no value
        for presses, spots in ((0, ((130, 120), (20, 30))), (6, ((126, 119),))):
            frame.focus()
            at.keyboard.press("0")
            for _ in range(presses):
                at.keyboard.press("+")
            for x, y in spots:
                at.mouse.move(*point_on_screen(at, x + 0.2, y - 0.2))
                expect(readout).to_contain_text(re.compile(rf"grey {stored[y, x]} of 255$"))
    page.sound()


@pytest.mark.parametrize("mode", ["Image", "3-D surface", "Side by side"])
def test_tab_reaches_everything_and_the_focus_is_seen(page: Watched, bench: Bench, mode: str) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name=mode).click()
    at.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true })")
    expect(at.get_by_role("button", name="Save the file")).to_be_visible()
    if mode == "Side by side":
        expect(at.locator('canvas[data-role="map-other"]')).to_have_attribute("data-shown", "2 w_mm reference")
    elif mode == "Image":
        given(at, LINE, (80, 90, 160, 90))
        at.get_by_role("button", name="Use").first.click()
        expect(at.get_by_role("button", name="End of the line")).to_be_visible()
    at.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    at.locator("#bar").click(position={"x": 2, "y": 2})
    order = tabbed(at)
    assert [one for one in order if not one["drawn"] or not one["seen"]] == []
    assert [one for one in at.evaluate(UNREACHED) if "skip" not in one] == []
    page.sound()


def test_gauges_and_the_probe_are_set_by_keyboard(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    frame = at.locator(".view .frame").first
    at.get_by_role("button", name="Line", exact=True).press("Enter")
    expect(frame).to_be_focused()
    at.keyboard.press("ArrowUp")  # shows the cross-hair
    cross = at.locator(".aim")
    start = [float(cross.get_attribute(f"data-{a}") or "nan") for a in "xy"]
    for key in ("Enter", *["Shift+ArrowRight"] * 3, "ArrowDown", "Enter"):
        at.keyboard.press(key)
    answer_of(at, "line-chart")
    ends = [float(at.get_by_label(name).input_value()) for name in LINE]
    assert ends == pytest.approx([*start, start[0] + 30, start[1] + 1], abs=0.05)
    # an end moves by keys too, and is read once they rest
    end = at.get_by_role("button", name="End of the line")
    end.focus()
    at.keyboard.press("Shift+ArrowRight")
    at.keyboard.press("ArrowUp")
    expect(end).to_be_focused()
    expect(at.get_by_label("Line to x")).to_have_value(re.compile(rf"^{start[0] + 40:g}$"))
    # Escape leaves; with the probe, Enter reads the point under the cross-hair
    at.keyboard.press("Escape")
    expect(frame).to_be_focused()
    at.keyboard.press("Escape")
    expect(at.get_by_role("button", name="Probe", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(cross).to_have_count(0)
    at.keyboard.press("Enter")
    at.keyboard.press("Enter")
    x, y = bench.field(2, "x_px"), bench.field(2, "y_px")
    nearest = np.unravel_index(np.argmin(np.hypot(x - start[0], y - start[1])), x.shape)
    wanted = re.compile(rf"row {nearest[0]}, column {nearest[1]}, step 2")
    expect(at.locator('[data-role="probe"]')).to_contain_text(wanted)
    page.sound()


def test_an_areas_statistics_are_the_gauges(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Area", exact=True).click()
    drag(at, (90, 90), (150, 140))
    got = answer_of(at, "area")[2]
    corners = [float(at.get_by_label(f"Area {side}").input_value()) for side in ("left", "top", "right", "bottom")]
    body = {"areas": [{"rectangle_px": corners}], "variables": ["w_mm"]}
    expected = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body).json()["steps"][2]["areas"][0][
        "values"
    ]["w_mm"]
    assert got == expected
    w, x, y = (bench.field(2, name) for name in ("w_mm", "x_px", "y_px"))
    inside = (x >= corners[0]) & (x <= corners[2]) & (y >= corners[1]) & (y <= corners[3])
    assert got["mean"] == pytest.approx(float(w[inside].mean()), abs=1e-12)
    page.sound()


def exported_triangles(bench: Bench, analysis_id: str) -> int:
    """Number of triangles of step 2 in the mesh that is exported."""
    field = read_field(bench.service.tests.result_file(bench.test_id, analysis_id, 2))
    return len(triangles_of(field.x_px, field.y_px, field.valid, field.cuts))


def test_a_slanting_crack_opens_the_surface_along_its_line_alone(page: Watched, bench: Bench) -> None:
    slant = with_a_cut(bench.service, bench.test_id, bench.analysis_id, [(73.0, 74.0), (166.0, 158.0)])
    at = shown(page, bench, analysis_id=slant)
    at.get_by_role("button", name="3-D surface").click()
    space = at.locator(".space")
    expect(space).to_have_attribute("data-drawn", "2 w_mm")
    left = exported_triangles(bench, slant)
    expect(space).to_have_attribute("data-triangles", str(left))
    assert left > 0.75 * exported_triangles(bench, bench.analysis_id)  # its bounding box is two thirds of the region
    page.sound()


def test_the_surface_stands_in_space_without_what_was_not_measured(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, analysis_id=bench.cut_id)
    at.get_by_role("button", name="3-D surface").click()
    space = at.locator(".space")
    expect(space).to_have_attribute("data-drawn", "2 w_mm")
    expect(space).to_have_attribute("data-triangles", str(exported_triangles(bench, bench.cut_id)))
    before = picture(space.screenshot())
    box = space.bounding_box()
    assert box is not None
    ground = before[3, 3].astype(int)
    coloured = (np.ptp(before.astype(int), axis=2) > 40).mean()  # viridis is colourful, ground and axes are grey
    assert coloured > 0.05, ground
    at.get_by_label("Displacement ×").fill("1")
    at.get_by_label("Displacement ×").press("Tab")
    expect(space).to_have_attribute("data-magnification", "1")
    expect(space.locator(".labels span").filter(has_text="Z (mm)")).to_have_count(1)
    at.wait_for_timeout(300)
    space.focus()
    at.keyboard.press("ArrowLeft")
    at.wait_for_timeout(500)
    assert (picture(space.screenshot()).astype(int) != before).any(axis=2).mean() > 0.02
    page.sound()


def test_the_difference_of_two_analyses(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Side by side").click()
    at.get_by_label("Compared with").select_option(label="with a cut")
    other = at.locator('canvas[data-role="map-other"]')
    expect(other).to_have_attribute("data-shown", "2 w_mm reference")
    # both views show the same part
    first, second = at.locator(".view .content").nth(0), at.locator(".view .content").nth(1)
    at.locator(".view .frame").first.focus()
    at.keyboard.press("+")
    at.keyboard.press("ArrowLeft")
    expect(second).to_have_attribute("style", first.get_attribute("style") or "")
    at.get_by_label("Right view").select_option("difference")
    figures = at.locator('[data-role="difference"]')
    expect(figures).to_have_attribute("data-count", re.compile(".+"))
    w, v = bench.field(2, "w_mm"), bench.field(2, "w_mm", bench.cut_id)
    both = np.isin(bench.field(2, "status", bench.cut_id), (0, 10)) & np.isin(bench.field(2, "status"), (0, 10))
    assert int(figures.get_attribute("data-count") or 0) == both.sum() == w.size - 3
    assert float(figures.get_attribute("data-mean") or 0) == pytest.approx(float((w - v)[both].mean()), abs=1e-9)
    assert float(figures.get_attribute("data-rms") or 0) == pytest.approx(1e-3, abs=1e-9)
    s = [bench.field(2, "sigma_w_mm", a) ** 2 for a in (bench.analysis_id, bench.cut_id)]
    reported = np.sqrt(np.mean((s[0] + s[1])[both]))
    assert float(figures.get_attribute("data-reported") or 0) == pytest.approx(reported, rel=1e-5)
    page.sound()


def test_settings_checks_and_files(page: Watched, bench: Bench) -> None:
    page.open("#/results")
    at = page.page
    expect(at.get_by_role("heading", name="plate <b>&")).to_be_visible()
    at.get_by_role("link", name=bench.analysis_id).click()
    drawn(at, "2 w_mm reference")
    at.get_by_text("Settings, checks and warnings").click()
    about = at.locator('[data-role="about"]')
    expect(about.get_by_text("rectangle 60, 60, 180, 170")).to_be_visible()
    expect(about.locator("tbody tr")).to_have_count(3)
    at.get_by_text("Export and report").click()
    # what is saved is in the axes that are shown, unless others are asked for
    with at.expect_download() as saved:
        at.get_by_role("button", name="Save the file").click()
    assert read_head(saved.value.path()).frame.startswith("aligned by plane, X along camera 1's image rows")
    at.get_by_label("frame", exact=True).fill("system")
    with at.expect_download() as saved:
        at.get_by_role("button", name="Save the file").click()
    assert saved.value.suggested_filename.endswith(".nc")
    stored = bench.service.tests.result_file(bench.test_id, bench.analysis_id, 2)
    with xarray.open_dataset(saved.value.path()) as one, xarray.open_dataset(stored) as other:
        xarray.testing.assert_identical(one[list(other.variables)].drop_attrs(), other.drop_attrs())
        # what was recorded with the step stands beside its result
        assert set(one.variables) - set(other.variables) <= {"load_n", "time_s", "channel_stroke_mm"}
    # an analysis that is not there
    at.goto(f"{page.origin}/#/results/{bench.test_id}/a000099-ffffff")
    expect(at.locator(".problem")).to_contain_text("a000099-ffffff")
    page.sound(404)


PLAY = """async address => {
    const film = document.createElement('video');
    Object.assign(film, {muted: true, src: address});
    document.body.append(film);
    const ended = new Promise((done, fail) => {
        film.addEventListener('ended', done);
        film.addEventListener('error', () => fail(new Error(film.error.message)));
    });
    await film.play();
    await ended;
    const seen = document.createElement('canvas');
    [seen.width, seen.height] = [film.videoWidth, film.videoHeight];
    const pen = seen.getContext('2d');
    pen.drawImage(film, 0, 0);
    return {width: seen.width, height: seen.height, seconds: film.duration,
            rgba: [...pen.getImageData(0, 0, seen.width, seen.height).data]};
}"""


def test_the_browser_plays_the_films(page: Watched, bench: Bench) -> None:
    page.open("#/jobs")
    query = "variables=w_mm&fps=4&width_px=400"
    film = page.page.evaluate(PLAY, f"{bench.path()}/export?format=mp4&{query}")
    gif = Image.open(io.BytesIO(bench.client.get(f"{bench.path()}/export?format=gif&{query}").content))
    assert (film["width"], film["height"]) == (gif.width & ~1, gif.height & ~1)
    assert film["seconds"] == pytest.approx(2 / 4, abs=0.05)  # the reference has no displacement
    gif.seek(1)
    seen = np.array(film["rgba"], dtype=int).reshape(film["height"], film["width"], 4)[..., :3]
    wanted = np.asarray(gif.convert("RGB"), dtype=int)[: film["height"], : film["width"]]
    # the last frame, as near as a film keeps its colours
    assert np.abs(seen - wanted).mean() < 8
    page.sound()


def test_on_a_tablet_and_in_the_dark(chromium: Browser, bench: Bench) -> None:
    origin = str(bench.client.base_url).rstrip("/")
    size = {"width": 820, "height": 1180}
    with watched(chromium, origin, viewport=size, has_touch=True, color_scheme="dark") as page:
        at = shown(page, bench, name="exx")
        assert not at.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth")
        expect(at.get_by_role("button", name="STOP")).to_be_in_viewport()
        at.get_by_label("Step", exact=True).focus()
        at.keyboard.press("ArrowLeft")
        drawn(at, "1 exx reference")
        page.sound()


def test_a_failed_check_stands_at_the_head_of_the_results_and_in_the_lists(page: Watched, bench: Bench) -> None:
    doubtful = with_a_cut(bench.service, bench.test_id, bench.analysis_id)
    folder = bench.service.tests.analysis_path(bench.test_id, doubtful)
    check = {"level": "failed", "offset_px": 0.115, "reason": "camera 2 sees the points 0.115 px off"}
    found = {"n": 2, "points": 900, "valid": 371, "valid_fraction": 371 / 900, "epipolar_check": check, "status": {}}
    (folder / "step_0002.json").write_text(json.dumps(found))
    at = shown(page, bench, analysis_id=doubtful)
    head = at.locator('[data-role="warnings"]')
    expect(head.locator("[data-warning]")).to_have_count(2)
    expect(head.locator('[data-warning="epipolar_check_failed"].bad')).to_contain_text("0.115 px off")
    expect(head.locator('[data-warning="epipolar_check_failed"].bad')).to_contain_text("calibrate again")
    expect(head.locator('[data-warning="low_coverage"].bad')).to_contain_text("371 of 900 (41 %)")
    box = head.bounding_box()
    picture_ = at.locator(".view .frame").first.bounding_box()
    assert box is not None
    assert picture_ is not None
    assert box["y"] + box["height"] < picture_["y"]  # above the picture, in the first window
    for address in (f"#/results/{bench.test_id}", f"#/test/{bench.test_id}"):
        page.open(address)
        row = at.get_by_role("row").filter(has=at.locator(f'a[href$="{doubtful}"]'))
        expect(row).to_contain_text("epipolar check failed")
        expect(row).to_contain_text("few points have values")
    entry = next(
        one
        for one in bench.client.get(f"{API}/tests/{bench.test_id}/analyses").json()["analyses"]
        if one["id"] == doubtful
    )
    assert [one["code"] for one in entry["warnings"]] == ["epipolar_check_failed", "low_coverage"]
    report = bench.client.get(f"{bench.path(doubtful)}/report").text
    assert report.index('data-warning="epipolar_check_failed"') < report.index('class="boxes"')
    page.sound()


def test_gauges_field_limits_and_colours_are_there_again_and_go_into_the_report(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_text("Extensometers", exact=True).click()
    given(at, ENDS, (80.0, 100.0, 160.0, 110.0))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    at.get_by_label("Colours", exact=True).select_option("cividis")
    at.get_by_label("Limits", exact=True).select_option("given")
    given(at, ("Lower limit", "Upper limit"), (-0.02, 0.03))
    at.get_by_label("Upper limit", exact=True).press("Tab")
    assert limits(at) == (-0.02, 0.03)
    # left at once, then opened anew
    at.goto("about:blank")
    page.open(f"#/results/{bench.test_id}/{bench.analysis_id}")
    drawn(at, "2 w_mm reference")
    assert limits(at) == (-0.02, 0.03)
    expect(at.locator('[data-role="colourbar"]').first).to_have_attribute("data-map", "cividis")
    expect(at.get_by_role("button", name="Remove e1")).to_be_attached()
    # limits are a field's own
    at.get_by_label("Field", exact=True).select_option("u_mm")
    drawn(at, "2 u_mm reference")
    assert limits(at) != (-0.02, 0.03)
    at.get_by_label("Field", exact=True).select_option("w_mm")
    drawn(at, "2 w_mm reference")
    at.wait_for_function("() => document.querySelector('[data-role=colourbar]').dataset.low === '-0.02'")
    metadata = find_source(bench.service.tests.analysis_path(bench.test_id, bench.analysis_id)).metadata
    assert metadata.gauges is not None
    [gauge] = metadata.gauges.extensometers
    assert (gauge.name, gauge.a_px, gauge.b_px) == ("e1", (80.0, 100.0), (160.0, 110.0))
    page.sound()


def test_an_analysis_without_a_result_shows_its_reason_and_no_dead_controls(page: Watched, bench: Bench) -> None:
    stored = bench.service.tests.analysis(bench.test_id, bench.analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "steps", "inputs", "software")}
    failed = bench.service.tests.create_analysis(bench.test_id, {**kept, "label": "failed"})
    bench.service.catalog.put_entry("analysis", bench.test_id, failed.id, analysis_entry(failed))
    problem = {"code": "image_blank", "cause": "There is noise only.", "remedy": "Check the lens cap."}
    summary = {"state": "failed", "steps": [], "problem": problem}
    bench.service.tests.put_summary(bench.test_id, failed.id, summary)
    at = page.open(f"#/results/{bench.test_id}/{failed.id}").locator("main")
    expect(at.get_by_text("There is noise only.")).to_be_visible()
    expect(at.get_by_text("No step of this analysis has a result.")).to_be_visible()
    expect(at.get_by_role("link", name="Measure again on the test's screen.")).to_be_visible()
    for dead in (at.get_by_role("button", name="Next step"), at.get_by_label("Field", exact=True)):
        expect(dead).to_be_hidden()
    expect(at.get_by_text("Export and report")).to_be_hidden()
    expect(at.get_by_text("Settings, checks and warnings")).to_be_visible()
    page.sound()
