"""The page's results in a browser: colours against values, numbers against the API's, nothing over a cut."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from stereorig.core.cameras.camera import Camera
from stereorig.core.field.region.triangles import triangles_of
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.results.netcdf import library
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.report.source import find_source
from stereorig.server.store.indexing.entries import analysis_entry
from stereorig.sim.plate import CircularPlate
from tests.support import results_page
from tests.support.page_bench import UNREACHED, Watched, tabbed, watched
from tests.support.results_page import (
    API,
    ENDS,
    LINE,
    RECTANGLE,
    Bench,
    drawn,
    given,
    shown,
    two_digits_of_u,
    with_a_cut,
)
from tests.support.service_rig import wait_for_job

bench, page = results_page.bench, results_page.page  # fixtures

pytestmark = pytest.mark.timeout(600)

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
    expect(at.locator('[data-role="opacity"]')).to_have_text("75\u00a0%")
    at.get_by_label("Opacity", exact=True).fill("100")
    expect(at.locator('[data-role="opacity"]')).to_have_text("100\u00a0%")
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
        expect(readout).to_contain_text(two_digits_of_u(w, reply["values"]["w_mm"]["sigma"]))
    at.mouse.click(*point_on_screen(at, 103.4, 98.2))
    reply = bench.client.get(
        f"{bench.path()}/probe", params={"x_px": 103.4, "y_px": 98.2, "step": 2, "frame": "specimen"}
    ).json()
    pinned = at.locator('[data-role="probe"]')
    expect(pinned).to_contain_text(f"row {reply['row']}, column {reply['col']}, step 2")
    row = pinned.locator("tr", has=at.get_by_role("cell", name="W", exact=True))
    w = reply["values"]["w_mm"]
    expect(row).to_contain_text(two_digits_of_u(w["value"], w["sigma"]))
    # what matters stands first
    expect(pinned.locator("table caption").first).to_have_text("Displacement")
    # X, Y and Z in one unit, whatever the size of each
    shape = [text for text in pinned.locator('[data-group="Shape"] td.numeric').all_inner_texts() if "±" in text]
    assert len(shape) == 3
    assert len({text.split()[-1] for text in shape}) == 1, shape
    # and its history: zero at the reference, then what each step measured; one request, not one a step
    asked: list[str] = []
    at.on("request", lambda request: asked.append(request.url))
    at.locator('[data-role="point"] summary').click()
    steps = [
        bench.client.get(
            f"{bench.path()}/probe", params={"x_px": 103.4, "y_px": 98.2, "step": n, "frame": "specimen"}
        ).json()["values"]["w_mm"]
        for n in (1, 2)
    ]
    got = answer_of(at, "point-chart")
    assert got["value"] == [0, *(one["value"] for one in steps)]
    assert got["sigma"] == [0, *(one["sigma"] for one in steps)]
    assert len([url for url in asked if "/history/w_mm?" in url]) == 1
    assert not [url for url in asked if "/probe?" in url or re.search(r"/steps/\d+$", url)]
    page.sound()


def test_the_interval_is_chosen_and_a_click_shows_the_budget(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    spot = (103.4, 98.2)
    query = {"x_px": spot[0], "y_px": spot[1], "step": 2, "coverage": 0.95}
    w = bench.client.get(f"{bench.path()}/probe", params=query).json()["values"]["w_mm"]
    readout, says = at.locator(".view .readout").first, at.locator('[data-role="includes"]')
    expect(says).to_contain_text("u (k = 1) includes matching, reference, calibration")
    at.mouse.move(*point_on_screen(at, *spot))
    expect(readout).to_contain_text(two_digits_of_u(w["value"], w["sigma"]))
    expect(readout).to_contain_text("u, k = 1")
    at.get_by_label("Uncertainties shown").select_option("95 %")
    expect(says).to_contain_text("U (k = 1.96, 95 %) includes")
    at.mouse.move(*point_on_screen(at, spot[0] + 0.2, spot[1]))
    expect(readout).to_contain_text(two_digits_of_u(w["value"], w["expanded"]))
    at.mouse.click(*point_on_screen(at, *spot))
    row = at.locator('[data-role="probe"] tr', has=at.get_by_role("cell", name="W", exact=True)).first
    budget = row.locator('[data-role="budget"]')
    expect(budget).to_be_hidden()
    row.get_by_role("button").click()
    expect(budget).to_be_visible()
    for cause, part in w["budget"].items():
        expect(budget.locator("tr", has_text=cause)).to_contain_text(f"{100 * part**2 / w['sigma'] ** 2:.2g}"[:3])
    page.sound()


def test_numbers_without_the_calibrations_uncertainty_say_so(page: Watched, bench: Bench) -> None:
    whole = bench.service.tests.analyses.path(bench.test_id, bench.analysis_id)
    stored = bench.service.tests.analyses.read(bench.test_id, bench.analysis_id).plain()
    kept = {k: stored[k] for k in ("kind", "settings", "steps", "inputs", "software")}
    document = bench.service.tests.analyses.create(bench.test_id, {**kept, "label": "as imported"})
    bench.service.catalog.put_entry("analysis", bench.test_id, document.id, analysis_entry(document))
    folder = bench.service.tests.analyses.path(bench.test_id, document.id)
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
    expect(at.locator('[data-role="probe"]')).to_contain_text(lacking)
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
    """Wait until a chart has an answer ``a`` that fulfils a condition on it and ``arg``."""
    answer = f"const a = JSON.parse(document.querySelector('[data-role={role}]')?.dataset.answer ?? 'null')"
    at.wait_for_function(f"arg => {{ {answer}; return a !== null && ({condition}) }}", arg=arg)


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
    expect(at.get_by_role("button", name="Remove E2")).to_be_visible()
    at.get_by_label("Against", exact=True).select_option("load")
    at.get_by_label("Show", exact=True).select_option("elongation_mm")
    wait_for_chart(at, "extensometer-chart", "a.x[1] === 689 && a.value[1].length === 2")
    got = answer_of(at, "extensometer-chart")
    body = {"extensometers": [{"a_px": [120, 70], "b_px": [120, 160]}]}
    steps = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body).json()["steps"]
    listed = [one["extensometers"][0]["values"]["elongation_mm"] for one in steps]
    # at the reference, where nothing was measured, it is zero by definition
    assert [v[1] for v in got["value"]] == [0, *(one["value"] for one in listed[1:])]
    assert [v[1] for v in got["sigma"]] == [0, *(one["sigma"] for one in listed[1:])]
    assert got["x"] == [0.0, 689.0, 1378.0]
    at.get_by_label("Against", exact=True).select_option("channel:stroke_mm")
    wait_for_chart(at, "extensometer-chart", "a.x[2] === 6.89")
    at.get_by_role("button", name="Remove E1").click()
    expect(at.get_by_role("button", name="Remove E1")).to_have_count(0)
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
    elif mode == "3-D surface":  # a focus on what it replaces would go to the whole panel
        expect(at.locator(".surface-note")).to_contain_text("axes in mm")
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
    field = read_field(bench.service.tests.analyses.result_file(bench.test_id, analysis_id, 2))
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
    number = re.compile(r"-?[0-9.]+(?=px|\))")  # the views' widths may differ by a part of a pixel

    def apart() -> float:
        one, two = (number.findall(view.get_attribute("style") or "") for view in (first, second))
        return max(abs(float(a) - float(b)) for a, b in zip(one, two, strict=True))

    for _ in range(100):
        if apart() < 0.1:
            break
        at.wait_for_timeout(100)
    assert apart() < 0.1
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
    at.get_by_text("Settings and checks").click()
    about = at.locator('[data-role="about"]')
    expect(about.get_by_text("rectangle 60, 60, 180, 170")).to_be_visible()
    expect(about.locator("tbody tr")).to_have_count(3)
    # lengths below 0.1 mm in micrometres here too
    of_step = bench.client.get(bench.path()).json()["summary"]["steps"][2]
    expect(about.locator("tbody tr").nth(2)).to_contain_text(f"{of_step['sigma_median_mm']['w_mm'] * 1e3:.2g}\u00a0µm")
    expect(about).not_to_contain_text("e−5")
    at.get_by_role("button", name="Export", exact=True).click()
    # what is saved is in the axes that are shown, unless others are asked for
    with at.expect_download() as saved:
        at.get_by_role("button", name="Save the file").click()
    assert read_head(saved.value.path()).frame.startswith("aligned by plane, X along camera 1's image rows")
    at.get_by_label("Axes", exact=True).select_option("system")
    drawn(at, "2 w_mm reference")
    with at.expect_download() as saved:
        at.get_by_role("button", name="Save the file").click()
    assert saved.value.suggested_filename.endswith(".nc")
    stored = bench.service.tests.analyses.result_file(bench.test_id, bench.analysis_id, 2)
    with library, xarray.open_dataset(saved.value.path()) as one, xarray.open_dataset(stored) as other:
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
    folder = bench.service.tests.analyses.path(bench.test_id, doubtful)
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


def test_what_is_shown_is_what_is_saved(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, name="exx")
    panel = at.locator('[data-role="files"]')
    for label, value in (("Colours", "diverging"), ("Limits", "given")):
        at.get_by_label(label, exact=True).select_option(value)
    for label, text in (("Lower limit", "-300"), ("Upper limit", "300"), ("Levels", "6")):
        at.get_by_label(label, exact=True).fill(text)
        at.get_by_label(label, exact=True).press("Tab")
    at.get_by_role("button", name="Export", exact=True).click()
    said = panel.locator('[data-role="seen"]')
    expect(said).to_contain_text("blue to brown from \N{MINUS SIGN}300 to 300 µm/m, 6 levels")
    expect(said).to_contain_text("axes of the specimen")
    colours = at.evaluate(
        "() => { const bar = document.querySelector('.colourbar canvas');"
        " return [...bar.getContext('2d').getImageData(0, 0, bar.width, 1).data] }"
    )
    bar = np.array(colours).reshape(-1, 4)[::43, :3][:6]
    panel.get_by_label("over the reference image").uncheck()
    with at.expect_download() as saved:
        panel.get_by_role("button", name="Save as PNG").click()
    pixels = picture(saved.value.path().read_bytes()).reshape(-1, 3).astype(int)
    for colour in bar[[0, 5]]:  # the bar's ends, as the page has them
        assert (np.abs(pixels - colour).max(axis=1) <= 2).sum() > 500
    with at.expect_download() as saved:
        panel.get_by_role("button", name="Save as SVG").click()
    text = saved.value.path().read_text()
    for words in ("plate &lt;b&gt;&amp;", "step 2", "µm/m", ">\N{MINUS SIGN}300<", ">300<", "aligned by plane", " mm<"):
        assert words in text, words
    panel.get_by_label("Film as", exact=True).select_option("gif")
    panel.get_by_label("Width", exact=True).fill("300")
    with at.expect_download() as saved:
        panel.get_by_role("button", name="Make the film").click()
    with Image.open(saved.value.path()) as film:
        assert (film.width, film.n_frames) == (300, 2)  # type: ignore[attr-defined]
    expect(panel.locator('[data-role="export-course"]')).to_contain_text("Saved as")
    panel.get_by_label("Width", exact=True).fill("30")
    panel.get_by_role("button", name="Save as PNG").click()
    expect(at.get_by_role("alert").filter(has_text="200 to 4,000 px wide")).to_be_visible()
    page.sound()


def test_a_plot_is_saved_as_numbers_and_as_pictures_and_starts_at_the_reference(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    for panel_of in (ENDS[0], "Area left"):
        at.locator("details", has=at.get_by_label(panel_of)).evaluate("one => { one.open = true }")
    given(at, ENDS, (80, 90, 160, 90))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    answer_of(at, "extensometer-chart")
    wait_for_chart(at, "extensometer-chart", "a.x.length === 3 && a.x[2] === 6.89")  # against what drives the test
    got = answer_of(at, "extensometer-chart")
    assert (got["x"][0], got["value"][0]) == (0, [0])  # the reference is zero, not missing
    chart = at.locator('[data-role="extensometer-chart"]')
    with at.expect_download() as saved:
        chart.get_by_role("button", name="Save as CSV").click()
    said, head, *lines = saved.value.path().read_text().splitlines()
    assert "k = 1" in said
    assert head == "stroke (mm),strain (µm/m),u of E1 (µm/m)"
    table = np.array([[float(v) for v in line.split(",")] for line in lines])
    np.testing.assert_allclose(table[:, 1], [1e6 * v[0] for v in got["value"]], rtol=1e-12)
    np.testing.assert_allclose(table[1:, 2], [1e6 * s[0] for s in got["sigma"][1:]], rtol=1e-12)
    with at.expect_download() as saved:
        chart.get_by_role("button", name="Save as PNG").click()
    assert picture(saved.value.path().read_bytes()).shape == (960, 1800, 3)
    with at.expect_download() as saved:
        chart.get_by_role("button", name="Save as SVG").click()
    drawing = saved.value.path().read_text()
    for words in ("stroke (mm)", "strain (µm/m)", "E1", "k = 1"):
        assert words in drawing
    # wide enough to read
    box, panel = chart.bounding_box(), at.locator(".tabs").bounding_box()
    assert box is not None
    assert panel is not None
    assert box["width"] > 0.9 * panel["width"]
    at.locator("summary").get_by_text("Areas", exact=True).click()
    given(at, ("Area left", "Area top", "Area right", "Area bottom"), (90, 90, 150, 140))
    at.locator("details", has=at.get_by_label("Area left")).get_by_role("button", name="Use").click()
    expect(at.locator('[data-role="area-chart"] canvas')).to_be_visible()
    page.sound()


def test_picture_and_numbers_stand_on_one_screen_a_tab_at_a_time(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, name="exx")
    for size in ((1440, 900), (1024, 768)):
        at.set_viewport_size({"width": size[0], "height": size[1]})
        expect(at.locator('[data-role="colourbar"]')).to_be_in_viewport(ratio=1)
        expect(at.locator(".view .frame")).to_be_in_viewport(ratio=1)
        assert at.evaluate("document.documentElement.scrollHeight") <= size[1]
    picture_box, bar = (at.locator(where).bounding_box() for where in (".stage", '[data-role="colourbar"]'))
    assert picture_box is not None
    assert bar is not None
    assert picture_box["y"] < bar["y"] < picture_box["y"] + picture_box["height"] - bar["height"]
    for name in ("Line", "Extensometers", "Areas", "History", "Statistics", "Statistics"):
        at.locator("summary").get_by_text(name, exact=True).click()
        open_ = at.locator(".tabs details.panel[open] > summary")
        expect(open_).to_have_text([name])
    at.get_by_role("button", name="Export", exact=True).click()
    expect(at.get_by_role("button", name="Save the file")).to_be_visible()
    expect(at.locator('[data-role="statistics"]')).to_be_hidden()
    page.sound()


def bars(at: Page) -> list[float]:
    """Return the bar's height at three widths, in each of which all lies within the window."""
    found = []
    for size in ((1440, 900), (1024, 768), (390, 844)):
        at.set_viewport_size({"width": size[0], "height": size[1]})
        # charts are drawn anew a moment after the window has another size
        at.wait_for_function("() => document.documentElement.scrollWidth <= document.documentElement.clientWidth")
        found.append(at.evaluate("document.getElementById('bar').offsetHeight"))
    return found


def test_a_running_analysis_is_followed_until_it_is_finished(page: Watched, bench: Bench) -> None:
    calibration = bench.client.get(f"{API}/tests/{bench.test_id}").json()["calibration_id"]
    test_id = bench.client.post(f"{API}/tests", json={"name": "followed", "calibration_id": calibration}).json()["id"]

    def capture(load: float) -> None:
        bench.client.put(f"{API}/sim/scene", json={"scene": "plate", "load": load})
        assert bench.client.post(f"{API}/tests/{test_id}/steps", json={"load_n": load}).status_code == 201

    capture(0.0)
    asked = {"region": {"rectangle": RECTANGLE}, "subset_px": 25, "spacing_px": 10, "follow": True}
    made = bench.client.post(f"{API}/tests/{test_id}/analyses", json=asked).json()
    page.open(f"#/results/{test_id}/{made['analysis_id']}")
    at = page.page
    at.set_default_timeout(60_000)
    # the reference has no W: its shape is shown, and W as soon as a step has it
    drawn(at, "0 z_mm reference")
    counter, follow = at.locator('[data-role="step"]'), at.get_by_label("follow the newest step")
    expect(counter).to_contain_text("1 of 1")
    expect(follow).to_be_checked()
    at.locator("details", has=at.get_by_label(ENDS[0])).evaluate("one => { one.open = true }")
    given(at, ENDS, (80, 90, 160, 90))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    assert len(answer_of(at, "extensometer-chart")["x"]) == 1
    capture(344.5)
    drawn(at, "1 w_mm reference")
    expect(counter).to_contain_text("2 of 2")
    wait_for_chart(at, "extensometer-chart", "a.x.length === 2")  # histories are read anew
    # who looks at an earlier step stays there; the counter is right at once
    at.get_by_role("button", name="Step before").click()
    drawn(at, "0 z_mm reference")
    expect(follow).not_to_be_checked()
    capture(689.0)
    expect(counter).to_contain_text("1 of 3")
    wait_for_chart(at, "extensometer-chart", "a.x.length === 3")
    expect(at.locator('canvas[data-role="map"]')).to_have_attribute("data-shown", "0 z_mm reference")
    follow.check()
    drawn(at, "2 w_mm reference")
    # a job at work moves nothing: the bar is as high as without one, and the buttons are on one line
    expect(at.locator("#bar-job")).to_be_visible()
    busy = bars(at)
    at.reload()  # nothing is said of a job that waits: who comes later asks
    expect(at.locator("#bar-job")).to_contain_text("analysis")
    # the test's screen says so, too, and either of them finishes it
    page.open(f"#/test/{test_id}?at=measure")
    expect(at.locator('[data-role="measuring"]')).to_have_text("measuring: waiting for the next step")
    at.locator('[data-role="progress"]').get_by_role("button", name="Finish").click()
    expect(at.locator('[data-role="progress"] .badge')).to_have_text("succeeded")
    expect(at.locator('[data-role="measuring"]')).to_have_text("")
    expect(at.locator("#bar-job")).to_be_hidden()
    assert bars(at) == busy
    document = bench.client.get(f"{API}/tests/{test_id}/analyses/{made['analysis_id']}").json()
    assert document["steps_finished"] == [0, 1, 2]
    page.sound()


def test_a_failed_analysis_shows_its_problem_and_nothing_to_choose(page: Watched, bench: Bench) -> None:
    asked = {"region": {"rectangle": RECTANGLE}, "max_sigma_px": 0.001}  # no match is as good
    made = bench.client.post(f"{API}/tests/{bench.test_id}/analyses", json=asked).json()
    assert wait_for_job(bench.client, made["job"])["state"] == "failed"
    page.open(f"#/results/{bench.test_id}/{made['analysis_id']}")
    at = page.page
    expect(at.locator(".problem").first).to_be_visible()
    for name in ("Field", "Step", "Image"):
        expect(at.get_by_label(name, exact=True)).to_be_hidden()
    for name in ("Play through the steps", "3-D surface", "Save the file"):
        expect(at.get_by_role("button", name=name)).to_have_count(0)
    expect(at.get_by_role("link", name="Back to the test")).to_be_visible()
    page.sound()


def test_lines_and_vectors_lie_over_the_map_and_the_surface(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, analysis_id=bench.cut_id)
    over = at.locator("g.overlay")
    at.get_by_label("contour lines, about").check()
    at.get_by_label("Vectors", exact=True).select_option("displacement")
    expect(over).to_have_attribute("data-vectors", str(13 * 12 - 3))  # one a point that has a value
    pieces = int(over.get_attribute("data-lines") or 0)
    assert pieces > 50
    # the legend's arrow is as long as its figure says: the drawn arrows have the same scale
    legend = at.locator(".view .arrow-legend")
    expect(legend).to_contain_text("µm")
    u, v = (bench.field(2, name, bench.cut_id) for name in ("u_mm", "v_mm"))
    status = np.isin(bench.field(2, "status", bench.cut_id), (0, 10))
    typical = np.sort(np.hypot(u, v)[status])[int(0.95 * (status.sum() - 1))]
    stated = float((legend.get_attribute("data-text") or "").split("\u00a0")[0]) * 1e-3
    # 0.9 of the room between two points, 10 px, for the vector that 95 % do not exceed
    zoom = at.locator(".view .content").first.evaluate("one => new DOMMatrix(one.style.transform).a")
    assert float(legend.get_attribute("data-length") or 0) == pytest.approx(9 * zoom * stated / typical, rel=1e-3)
    at.get_by_label("A vector every so many points").fill("3")
    at.get_by_label("A vector every so many points").press("Tab")
    expect(over).to_have_attribute("data-vectors", re.compile(r"^(1[4-9]|20)$"))
    at.get_by_role("button", name="3-D surface").click()
    space = at.locator(".space")
    expect(space).to_have_attribute("data-lines", str(pieces))  # the same lines, open at the same crack
    expect(space.locator(".arrow-legend")).to_contain_text("mm")
    # the axes turn with the view
    triad = space.locator(".triad")
    before = triad.get_attribute("data-x")
    space.focus()
    at.keyboard.press("ArrowLeft")
    expect(triad).not_to_have_attribute("data-x", before or "")
    for factor in ("0", "1000"):
        at.get_by_label("Displacement ×").fill(factor)
        at.get_by_label("Displacement ×").press("Tab")
        expect(space).to_have_attribute("data-magnification", factor)
    at.get_by_label("Displacement ×").fill("1001")
    at.get_by_label("Displacement ×").press("Tab")
    expect(at.get_by_text("Give a factor from 0 to 1000.")).to_be_visible()
    at.get_by_role("button", name="True scale").click()
    expect(space).to_have_attribute("data-magnification", "1")
    expect(at.get_by_text("Give a factor from 0 to 1000.")).to_be_hidden()
    page.sound()


def test_strain_is_shown_in_percent_by_choice(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, name="exx")
    bar = at.locator('[data-role="colourbar"] .of').first
    expect(bar).to_have_text("µm/m")
    at.get_by_label("Unit of strain").select_option("%")
    expect(bar).to_have_text("%")
    low, _ = limits(at)
    first = at.locator('[data-role="colourbar"] .marks span').first.inner_text().replace("\N{MINUS SIGN}", "-")
    assert float(first) == pytest.approx(low * 1e-4, abs=1e-3)
    assert low == pytest.approx(float(np.nanpercentile(bench.field(2, "exx"), 1)) * 1e6, rel=1e-4)
    # kept for the next time
    shown(page, bench, name="exx")
    expect(bar).to_have_text("%")
    page.sound()


def test_a_phone_shows_the_step_and_a_low_bar(chromium: Browser, bench: Bench) -> None:
    origin = str(bench.client.base_url).rstrip("/")
    with watched(chromium, origin, viewport={"width": 390, "height": 844}, has_touch=True) as page:
        at = shown(page, bench)
        assert not at.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth")
        bar, step = at.locator("#bar").bounding_box(), at.locator('[data-role="step"]').bounding_box()
        assert bar is not None
        assert step is not None
        assert bar["height"] < 844 / 8
        assert step["x"] + step["width"] <= 390
        expect(at.get_by_role("button", name="STOP")).to_be_in_viewport()
        # what a narrow table breaks into two lines begins where its column does
        page.open("#/results")
        name = at.get_by_role("row", name="plate <b>&").locator("button, a").first
        assert name.evaluate("node => getComputedStyle(node).textAlign") in ("left", "start")
        page.sound()


def test_nothing_moves_when_the_numbers_change(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    places = """() => ['.view .frame', '[data-role=colourbar]', 'input[aria-label=Step]', '[data-role=interval]']
        .map(one => { const b = document.querySelector(one).getBoundingClientRect(); return [b.x, b.y, b.width] })"""
    before = at.evaluate(places)
    for spot in ((103.4, 98.2), (20.0, 30.0)):
        at.mouse.move(*point_on_screen(at, *spot))
        expect(at.locator(".view .readout").first).to_contain_text("grey")
        assert at.evaluate(places) == before
    at.get_by_role("button", name="Step before").click()
    drawn(at, "1 w_mm reference")
    assert at.evaluate(places) == before
    page.sound()


def test_several_lines_and_lines_over_the_steps_are_in_one_plot(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_role("button", name="Line", exact=True).click()
    both = ((75, 80, 165, 140), (120, 70, 120, 160))
    for ends in both:
        given(at, LINE, ends)
        at.locator("details", has=at.get_by_label(LINE[0])).get_by_role("button", name="Use").click()
        answer_of(at, "line-chart")
        at.get_by_role("button", name="Keep this line").click()
    wait_for_chart(at, "lines-chart", "a.length === 2")
    at.get_by_label("Steps of the lines").select_option("all")
    wait_for_chart(at, "lines-chart", "a.length === 4")  # the reference has no W
    body = {"lines": [{"vertices_px": [e[:2], e[2:]]} for e in both], "variables": ["w_mm"]}
    steps = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=body).json()["steps"]
    wanted = [(f"L{k + 1}, step {n}", steps[n]["lines"][k]["values"]["w_mm"]["value"]) for n in (1, 2) for k in (0, 1)]
    assert [(one["label"], one["value"]) for one in answer_of(at, "lines-chart")] == wanted
    at.get_by_role("button", name="Remove L1").click()
    wait_for_chart(at, "lines-chart", "a.length === 2")
    page.sound()


def test_the_size_of_the_displacement_is_a_field_with_its_uncertainty(page: Watched, bench: Bench) -> None:
    at = shown(page, bench, name="d_mm")
    uvw = np.stack([bench.field(2, name) for name in ("u_mm", "v_mm", "w_mm")])
    assert bench.field(2, "d_mm") == pytest.approx(np.linalg.norm(uvw, axis=0), rel=1e-6)
    low, high = limits(at)
    assert (low, high) == pytest.approx(tuple(np.nanpercentile(bench.field(2, "d_mm"), [1, 99])), rel=1e-6)
    # nearly all of it is W here, so its uncertainty is that of W
    assert bench.field(2, "sigma_d_mm") == pytest.approx(bench.field(2, "sigma_w_mm"), rel=0.02)
    at.mouse.move(*point_on_screen(at, 103.4, 98.2))
    expect(at.locator(".view .readout").first).to_contain_text("±")
    query = {"format": "csv", "variables": "d_mm,sigma_d_mm", "step": 2}
    lines = bench.client.get(f"{bench.path()}/export", params=query).text.splitlines()
    head = next(line for line in lines if not line.startswith("#"))
    assert {"d_mm", "sigma_d_mm"} <= set(head.split(","))
    area = {"areas": [{"rectangle_px": [90, 90, 150, 140]}], "variables": ["d_mm"], "steps": [2]}
    read = bench.client.post(f"{bench.path()}/gauges?frame=specimen", json=area).json()["steps"][0]["areas"][0]
    x, y = bench.field(2, "x_px"), bench.field(2, "y_px")
    inside = (x >= 90) & (x <= 150) & (y >= 90) & (y <= 140)
    assert read["values"]["d_mm"]["mean"] == pytest.approx(float(np.linalg.norm(uvw, axis=0)[inside].mean()), abs=1e-9)
    page.sound()


def test_gauges_field_limits_and_colours_are_there_again_and_go_into_the_report(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_text("Extensometers", exact=True).click()
    given(at, ENDS, (80.0, 100.0, 160.0, 110.0))
    at.locator("details", has=at.get_by_label(ENDS[0])).get_by_role("button", name="Use").click()
    at.locator("summary").get_by_text("Statistics", exact=True).click()
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
    expect(at.get_by_role("button", name="Remove E1")).to_be_attached()
    # limits are a field's own
    at.get_by_label("Field", exact=True).select_option("u_mm")
    drawn(at, "2 u_mm reference")
    assert limits(at) != (-0.02, 0.03)
    at.get_by_label("Field", exact=True).select_option("w_mm")
    drawn(at, "2 w_mm reference")
    at.wait_for_function("() => document.querySelector('[data-role=colourbar]').dataset.low === '-0.02'")
    metadata = find_source(bench.service.tests.analyses.path(bench.test_id, bench.analysis_id)).metadata
    assert metadata.gauges is not None
    [gauge] = metadata.gauges.extensometers
    assert (gauge.name, gauge.a_px, gauge.b_px) == ("E1", (80.0, 100.0), (160.0, 110.0))
    page.sound()


def test_a_step_is_compared_with_a_model_on_the_page(page: Watched, bench: Bench, tmp_path: Path) -> None:
    # the plate of Eq. (18) as a model ten times too stiff: refuted where it bulges
    plate = CircularPlate(youngs_modulus_mpa=710.0e3)
    w0, radius = plate.centre_deflection_mm(689.0), plate.radius_mm
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-12.0, 12.0, 60)] * 2))
    q = np.minimum((x**2 + y**2) / radius**2, 1.0)
    w = -w0 * (1.0 - q) ** 2
    zero = np.zeros_like(x)
    rows = np.column_stack([x, y, zero, zero, zero, w])
    for name, head in (("model.csv", "x_mm,y_mm,z_mm,u_mm,v_mm,w_mm"), ("bare.csv", "x,y,z,u,v,w")):
        np.savetxt(tmp_path / name, rows, delimiter=",", header=head, comments="")
    at = shown(page, bench)
    at.locator('[data-role="models"] > summary').click()
    panel = at.locator('[data-role="models"]')
    panel.get_by_label("File", exact=True).set_input_files(tmp_path / "bare.csv")
    panel.get_by_role("button", name="Keep with the test").click()
    expect(at.get_by_text("states no unit of length").first).to_be_visible()
    panel.get_by_label("File", exact=True).set_input_files(tmp_path / "model.csv")
    panel.get_by_role("button", name="Keep with the test").click()
    expect(panel.locator('[data-role="model"]')).to_contain_text("model.csv (mm)")
    panel.get_by_role("button", name="Compare this step").click()
    expect(panel.locator('[data-role="model-verdict"]')).to_contain_text("refuted", timeout=120_000)
    found = bench.client.get(f"{API}/tests/{bench.test_id}/models").json()["models"][-1]
    body = {"model_id": found["id"], "step": 2}
    said = bench.client.post(f"{bench.path()}/comparison", json=body, timeout=120.0).json()
    assert not said["accepted"]
    assert panel.locator("rect[data-region]").count() == len(said["regions"])
    assert panel.locator("table").filter(has_text="Where the model is refuted").locator("tbody tr").count() == len(
        said["refuted"]
    )


def test_an_evaluation_is_run_on_the_page(page: Watched, bench: Bench) -> None:
    at = shown(page, bench)
    at.get_by_text("Evaluations", exact=True).click()
    panel = at.locator('[data-role="evaluations"]')
    panel.locator('[data-setting="variable"]').fill("w_mm")
    panel.locator('[data-setting="upper"]').fill("0.05")
    panel.locator('[data-setting="step"]').fill("2")
    panel.get_by_role("button", name="Evaluate").click()
    body = {"settings": {"variable": "w_mm", "upper": 0.05, "step": 2}}
    found = bench.client.post(f"{bench.path()}/evaluations/conformity", json=body, timeout=60.0).json()["document"]
    expect(panel.locator('[data-role="evaluation-verdict"]')).to_contain_text(found["verdict"])
    assert panel.locator("rect").count() == len(found["histogram"]["counts"])
    page.sound()
    panel.locator('[data-setting="upper"]').fill("")
    panel.get_by_role("button", name="Evaluate").click()
    expect(panel).to_contain_text("needs lower, upper or both")
