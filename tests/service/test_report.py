"""The report of a simulated plate, read by an HTML parser: every item a guide asks for, beside the simulated truth."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import shutil
import threading
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import xarray
from PIL import Image
from scipy.optimize import fsolve

from stereorig.server.cli import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.report.build import make_report
from stereorig.server.report.source import find_source
from stereorig.server.report.steps import read_steps
from stereorig.server.report.task import ReportOptions
from stereorig.server.workflows.service import Service
from stereorig.sim.texture import speckle
from tests.support.independent_rig import PlainCamera
from tests.support.patience import busy
from tests.support.report_page import Page
from tests.support.service_rig import SMALL, served, wait_for_job, wait_for_rig
from tests.support.texture_width import two_point_width_mm

API = "/api/v1"
NASTY = "Plate <script>alert(1)</script> & \"co\" 'x' </style>"
METADATA: dict[str, Any] = {
    "purpose": "Deflection of a clamped plate",
    "operator": "J\u00f6rg <b>Smith</b>",
    "laboratory": "A laboratory",
    "material": "Aluminium 6061-T6",
    "loading": "compressed air",
    "environment": "21 C",
    "lighting": "two LED panels",
    "pattern_technique": "white ground, black spray",
    "frame_rate_hz": 2.5,
    "static_steps": [1, 2, 3],
    "cam1": {
        "maker": "Basler",
        "sensor": "IMX250",
        "pixel_um": 3.45,
        "lens": {"maker": "Schneider", "model": "Xenoplan", "focal_length_mm": 50.0, "f_number": 8.0},
    },
    "cam2": {
        "maker": "Basler",
        "sensor": "IMX250",
        "pixel_um": 3.45,
        "lens": {"maker": "Schneider", "model": "Xenoplan", "focal_length_mm": 50.0, "f_number": 11.0},
    },
    "gauges": {
        "extensometers": [{"name": "ax<i>al", "a_px": [80.0, 110.0], "b_px": [160.0, 110.0]}],
        "points": [{"name": "centre", "xy_px": [130.0, 118.0]}],
        "areas": [{"name": "all"}],
        "lines": [{"name": "across", "vertices_px": [[80.0, 110.0], [160.0, 110.0]], "count": 9}],
        "variables": ["u_mm", "v_mm", "w_mm"],
    },
}
# hardware and analysis parameters of the reporting tables of the iDICs guide (2018), by the row's key
GUIDE = {
    "camera.maker",
    "camera.model",
    "camera.resolution",
    "camera.sensor",
    "camera.pixel",
    "lens.maker",
    "lens.model",
    "lens.focal_length",
    "lens.aperture",
    "field_of_view",
    "image_scale",
    "stereo_angle",
    "stand_off",
    "rate",
    "exposure",
    "lighting",
    "pattern.technique",
    "pattern.size",
    "noise",
    "software",
    "prefilter",
    "subset",
    "step",
    "shape_function",
    "criterion",
    "interpolant",
    "strain",
    "strain.window",
    "strain.gauge",
    "strain.filter",
    "smoothing",
    *(f"floor.{name}" for name in ("U", "V", "W", "X", "Y", "Z", "exx", "eyy", "exy")),
}


@dataclass
class Measurement:
    """What the tests share: the service, and where the analysis is."""

    client: httpx.Client
    service: Service
    test_id: str
    analysis_id: str

    @property
    def url(self) -> str:
        return f"{API}/tests/{self.test_id}/analyses/{self.analysis_id}/report"

    @property
    def folder(self) -> Path:
        return self.service.tests.analyses.path(self.test_id, self.analysis_id)

    @property
    def data(self) -> Path:
        return self.service.folder.root


def calibrated(client: httpx.Client) -> dict[str, Any]:
    """Calibrate; a machine that stalls for half a second makes a camera seem lost, which is tried again."""
    for _ in range(4):
        accepted: dict[str, Any] = client.post(f"{API}/calibrations", json={"frames": 4}).json()
        done = wait_for_job(client, accepted["job"])
        if done["state"] == "succeeded":
            return accepted
        assert done["problem"]["code"] == "camera_lost", done["problem"]
        wait_for_rig(client)
        time.sleep(2.0)
    raise AssertionError(done["problem"])


def captured(client: httpx.Client, test_id: str, body: dict[str, Any]) -> None:
    """Take a step, with the same patience."""
    for _ in range(4):
        step = client.post(f"{API}/tests/{test_id}/steps", json=body)
        if step.status_code == 201:
            return
        assert step.json()["code"] == "camera_lost", step.text
        time.sleep(2.0)
    raise AssertionError(step.text)


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Measurement]:
    """A plate: reference, three more at rest, two under pressure; measured with strain over five points."""
    service = Service(parse_config(SMALL), tmp_path_factory.mktemp("report") / "data").start()
    try:
        with served(service) as client:
            wait_for_rig(client)
            accepted = calibrated(client)
            body = {
                "name": NASTY,
                "specimen": "<img src=x onerror=alert(2)>",
                "calibration_id": accepted["calibration_id"],
            }
            test_id = client.post(f"{API}/tests", json=body).json()["id"]
            for load, label in ((0, "reference"), (0, "a"), (0, "b"), (0, "<b>c</b>"), (400, "400 kPa"), (689, "689")):
                client.put(f"{API}/sim/scene", json={"scene": "plate", "load": load})
                captured(client, test_id, {"label": label, "load_n": 0.5 * load})
            body = {
                "region": {"rectangle": [60, 60, 180, 170]},
                "subset_px": 25,
                "spacing_px": 10,
                "patch": "affine",
                "strain": {"window": 5},
            }
            accepted = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
            done = wait_for_job(client, accepted["job"], 240.0)
            assert done["state"] == "succeeded", done["problem"]
            assert client.put(f"{API}/tests/{test_id}/metadata", json=METADATA).status_code == 200
            yield Measurement(client, service, test_id, accepted["analysis_id"])
    finally:
        service.close()


@dataclass
class Answered:
    """The report as the API gave it, and how long the service let another request wait meanwhile."""

    response: httpx.Response
    slowest_s: float


@pytest.fixture(scope="module")
def answered(plate: Measurement) -> Answered:
    done: list[httpx.Response] = []
    slowest = 0.0
    with httpx.Client(base_url=plate.client.base_url, timeout=240.0, trust_env=False) as other:
        thread = threading.Thread(target=lambda: done.append(other.get(plate.url)))
        thread.start()
        while thread.is_alive():
            begun = time.monotonic()
            assert plate.client.get("/healthz").status_code == 200
            slowest = max(slowest, (time.monotonic() - begun) / busy())
            time.sleep(0.05)
        thread.join()
    assert done[0].status_code == 200, done[0].text
    return Answered(done[0], slowest)


@pytest.fixture(scope="module")
def page(plate: Measurement, tmp_path_factory: pytest.TempPathFactory) -> Page:
    out = tmp_path_factory.mktemp("page") / "report.html"
    assert main(["report", str(plate.data), "--out", str(out)]) == 0
    return Page(out.read_text())


def true_camera(name: str) -> PlainCamera:
    """The simulated camera as the rig file's truth has it, in formulas of its own."""
    rig = tomllib.loads(SMALL)
    true = rig["sim"][name]
    return PlainCamera(
        tuple(rig[name]["image_size_px"]),
        true["phd_px"],
        true["cx_px"],
        true["cy_px"],
        true["kappa_per_px2"],
        true["aspect"],
        true["alpha_rad"],
        true["beta_rad"],
        true["gamma_rad"],
        true["x0_mm"],
        true["y0_mm"],
        true["z0_mm"],
    )


def on_plane(camera: PlainCamera, xy: list[float]) -> np.ndarray[Any, Any]:
    """The point of the plane Z = 0 that a camera sees at a pixel."""
    found = fsolve(lambda p: camera.project(np.array([p[0], p[1], 0.0])) - np.array(xy), [0.0, 0.0], xtol=1e-12)
    return np.array([found[0], found[1], 0.0])


def reported_numbers(page: Page, key: str) -> list[float]:
    return [n for n in page.rows[key].numbers if n is not None]


def test_every_item_of_the_guide_is_there_with_a_value(page: Page) -> None:
    assert page.rows.keys() >= GUIDE
    for key in GUIDE - {"floor.X", "floor.Y", "floor.Z"}:
        assert not any("not stated" in cell for cell in page.rows[key].cells), (key, page.rows[key])
    # what cannot be known is reported as unknown
    assert [page.rows[f"floor.{k}"].cells[1] for k in "XYZ"] == ["cannot be stated"] * 3


def test_angle_standoff_scale_and_view_are_the_rigs_own(page: Page, plate: Measurement) -> None:
    cameras = [true_camera(name) for name in ("cam1", "cam2")]
    axes = [camera.rotation()[2] for camera in cameras]
    angle = float(np.degrees(np.arccos(axes[0] @ axes[1])))
    assert reported_numbers(page, "stereo_angle") == [pytest.approx(angle, abs=0.02)]
    baseline = float(np.linalg.norm(cameras[0].centre() - cameras[1].centre()))
    assert reported_numbers(page, "baseline") == [pytest.approx(baseline, rel=3e-3)]
    with xarray.open_dataset(plate.folder / "step_0000.nc") as data:
        middle = np.array([float(data["x_mm"].median()), float(data["y_mm"].median()), 0.0])
    for k, (camera, axis) in enumerate(zip(cameras, axes, strict=True)):
        # the plate at rest is the plane Z = 0
        standoff = -camera.centre()[2] / axis[2]
        assert reported_numbers(page, "stand_off")[k] == pytest.approx(standoff, rel=4e-3)
        images = [camera.project(middle + np.array(d)) for d in ((0, 0, 0), (1e-4, 0, 0), (0, 1e-4, 0))]
        jacobian = np.stack([(p - images[0]) / 1e-4 for p in images[1:]], axis=-1)
        per_px = np.linalg.norm(np.linalg.inv(jacobian), axis=0)
        assert reported_numbers(page, "image_scale")[k] == pytest.approx(float(np.sqrt(np.prod(per_px))), rel=1e-3)
        width, height = camera.size
        ends = [on_plane(camera, [x, 0.5 * (height - 1)]) for x in (-0.5, width - 0.5)]
        assert reported_numbers(page, "field_of_view")[k] == pytest.approx(
            float(np.linalg.norm(ends[1] - ends[0])), rel=2e-3
        )


def test_pattern_size_is_the_textures(page: Page) -> None:
    rig = tomllib.loads(SMALL)
    scale = reported_numbers(page, "image_scale")[0]
    true_mm = two_point_width_mm(speckle(diameter_mm=rig["sim"]["speckle_mm"], seed=11))
    # widened by the pixel's square and the lens (0.7 px unless the rig states otherwise)
    blur = rig["sim"].get("blur_px", 0.7)
    true_px = np.sqrt((true_mm / scale) ** 2 + 2.355**2 * (1.0 / 6.0 + 2.0 * blur**2))
    row = page.rows["pattern.size"]
    assert reported_numbers(page, "pattern.size")[0] == pytest.approx(true_px, rel=0.12)
    assert "autocorrelation" in row.cells[-1]
    assert "mm" in row.cells[1]


def test_settings_are_told_in_px_and_mm(page: Page) -> None:
    scale = reported_numbers(page, "image_scale")[0]
    for key, px in (("subset", 25.0), ("step", 10.0), ("strain.gauge", 65.0)):
        assert reported_numbers(page, key) == [px]
        mm = re.search(r"= ([\d.]+) mm", page.rows[key].cells[1])
        assert mm is not None
        assert float(mm[1]) == pytest.approx(px * scale, rel=5e-3)
    for key, text in (
        ("shape_function", "affine"),
        ("criterion", "zero-mean"),
        ("interpolant", "quintic"),
        ("prefilter", "none"),
        ("smoothing", "none"),
        ("strain", "Green-Lagrange"),
        ("strain.window", "5 x 5"),
        ("software", "stereorig"),
        ("rate", "2.5 Hz"),
        ("exposure", "10 ms"),
        ("lens.aperture", "f/8"),
        ("lighting", "two LED panels"),
        ("camera.model", "simulated camera"),
        ("camera.maker", "Basler"),
        ("pattern.technique", "white ground, black spray"),
    ):
        assert text in " ".join(page.rows[key].cells), key
    assert reported_numbers(page, "lens.aperture") == [8.0, 11.0]
    # the fitted pinhole distance in mm, from the pixel's size
    assert f"{reported_numbers(page, 'lens.pinhole')[0] * 3.45e-3:.2f} mm" in page.rows["lens.pinhole"].cells[1]


def test_noise_floor_is_that_of_the_static_steps(page: Page, plate: Measurement) -> None:
    layers: dict[str, list[np.ndarray[Any, Any]]] = {}
    for n in (1, 2, 3):
        with xarray.open_dataset(plate.folder / f"step_{n:04d}.nc") as data:
            for name in ("u_mm", "v_mm", "w_mm", "exx", "eyy", "exy"):
                layers.setdefault(name, []).append(data[name].values.astype(float))
            layers.setdefault("z", []).append((data["z_mm"] + data["w_mm"]).values.astype(float))
            sigma = float(data["sigma_w_mm"].median())
    for name, key in (("u_mm", "U"), ("v_mm", "V"), ("w_mm", "W"), ("exx", "exx"), ("eyy", "eyy"), ("exy", "exy")):
        stack = np.stack(layers[name]).reshape(3, -1)
        stack = stack[:, np.isfinite(stack).all(axis=0)]
        bias, _, temporal, spatial, *_ = page.rows[f"floor.{key}"].numbers[1:]
        assert bias == pytest.approx(stack.mean(), rel=1e-3, abs=1e-9)
        assert temporal == pytest.approx(np.sqrt(stack.var(axis=0, ddof=1).mean()), rel=1e-3)
        assert spatial == pytest.approx(np.sqrt(stack.var(axis=1, ddof=1).mean()), rel=1e-3)
    z = np.stack(layers["z"])
    assert page.rows["floor.Z"].numbers[3] == pytest.approx(np.sqrt(np.nanmean(z.var(axis=0, ddof=1))), rel=1e-2)
    # nothing moved: the truth is zero, and what is left is what the points' own covariance predicts
    bias, _, _, spatial, reported, points = page.rows["floor.W"].numbers[1:]
    assert reported == pytest.approx(sigma, rel=0.02)
    assert spatial == pytest.approx(sigma, rel=0.3)
    assert abs(bias or 1.0) < 3.0 * sigma
    assert points == 156
    assert "1, 2, 3" in page.texts["noise-floor"]


def test_uncertainty_has_a_sentence_to_quote_and_a_budget(page: Page, plate: Measurement) -> None:
    sentence = page.texts["uncertainty-sentence"]
    for part in ("k = 1", "normal", "exact perspective", "common factor", "Not included: systematic terms"):
        assert part in sentence
    assert "calibration not included" not in sentence.lower()
    with xarray.open_dataset(plate.folder / "step_0005.nc") as data:
        sigma, F = float(data["sigma_w_mm"].median()), data["common_factor"].values.astype(float)
    _, _, matching, reference, calibration, stage, target, total = page.rows["budget.W"].numbers
    assert total == pytest.approx(1e3 * sigma, rel=1e-3)
    parts = [part or 0.0 for part in (matching, reference, calibration, stage, target)]
    assert np.sum(np.square(parts)) == pytest.approx((total or 0.0) ** 2, rel=0.1)  # medians of each
    common = 1e3 * float(np.nanmedian(np.linalg.norm(F[..., 5, :], axis=-1)))
    assert np.sqrt(np.sum(np.square(parts[2:]))) == pytest.approx(common, rel=0.1)
    assert page.rows["budget.ax<i>al.strain"].numbers[7] is not None
    assert "includes matching, reference, calibration" in page.texts["histories"]


def test_noise_of_the_images_is_the_sensors(page: Page) -> None:
    noise = tomllib.loads(SMALL)["sim"]["noise"]
    # electrons to grey levels of 8 bit, at half of full scale, with the rounding to whole grey levels
    per_grey = noise["full_well_e"] / 255.0
    sd = np.sqrt(noise["read_noise_e"] ** 2 + 0.48 * noise["full_well_e"]) / per_grey
    assert reported_numbers(page, "noise")[0] == pytest.approx(np.hypot(sd, 12**-0.5), rel=0.15)


def test_calibration_record_is_complete(page: Page, plate: Measurement) -> None:
    file = plate.service.tests.calibration_file(plate.test_id)
    content = json.loads(file.read_text())
    assert content["verdict"]["level"] in page.texts["calibration-verdict"]
    for which in ("fitted", "held_out"):
        for name in ("rbe_px", "raz_mm", "nsce"):
            checks = content["checks"][which]
            expected = [checks[name], *(checks["per_camera"][cam][name] for cam in ("cam1", "cam2"))]
            assert page.rows[f"calibration.{which}.{name}"].numbers[1:] == expected
    for name, value in content["cam1"].items():
        assert page.rows[f"parameter.{name}"].numbers[1:3] == [value, content["cam2"][name]]
        if f"cam1.{name}" in content["sigma"]:
            assert "\u00b1" in page.rows[f"parameter.{name}"].cells[1]
    views = page.tables["calibration-views"][1:]
    assert sorted(row.numbers[1] or 0.0 for row in views) == sorted(view["dz_mm"] for view in content["views"])
    assert sum("held out" in row.cells[2] for row in views) == 2
    assert "11 x 11 lines" in page.texts["calibration-target"]
    assert "ok" in page.texts["epipolar-check"]


def test_steps_and_histories(page: Page) -> None:
    head, *rows = page.tables["steps-table"]
    assert [row.cells[0] for row in rows] == ["0", *(f"{n} (static)" for n in (1, 2, 3)), "4", "5"]
    load, time_s = (next(k for k, cell in enumerate(head.cells) if cell.startswith(name)) for name in ("load", "time"))
    assert [row.numbers[load] for row in rows] == [0.0, 0.0, 0.0, 0.0, 200.0, 344.5]
    times = [row.numbers[time_s] or 0.0 for row in rows]
    assert times == sorted(times)
    assert times[-1] > 0.0
    names = [str(p["alt"]) for p in page.pictures()]
    for wanted in (
        "reference image of camera 1",
        "reference image of camera 2",
        "map of U in step 5",
        "map of V in step 5",
        "map of W in step 5",
        "map of exx in step 5",
        "map of eyy in step 5",
        "map of exy in step 5",
        "map of the reference's Z",
        "map of the points' states, step 5",
        "load over",
        "mean displacement",
        "mean strain",
        "Extensometer ax<i>al over",
        "Point centre over",
        "Area all over",
        "w_mm along line across",
    ):
        assert any(wanted in name for name in names), (wanted, names)
    # the plate's centre comes towards the cameras, Eq. (18): 0.8 of 2 * 0.5627 um per kPa
    centre = [page.rows[f"gauge.centre.{n}"].numbers[3] for n in (4, 5)]
    assert centre[1] == pytest.approx((centre[0] or 0.0) * 689.0 / 400.0, rel=0.02)


def test_gauges_are_rounded_as_on_the_page(page: Page) -> None:
    """Two digits of the uncertainty, the value to the same place, a column in one unit of a readable size."""
    for n in (4, 5):
        row = page.rows[f"gauge.ax<i>al.{n}"]
        for cell in row.cells[1:]:
            value, _, u = cell.replace("\u2212", "-").replace("\u202f", "").partition(" \u00b1 ")
            assert len(u.replace(".", "").strip("0")) <= 2, cell
            assert len(u.replace(".", "").lstrip("0")) >= 2, cell
            assert len(value.partition(".")[2]) == len(u.partition(".")[2]), cell
        strain = float(row.cells[2].replace("\u2212", "-").partition(" ")[0])
        assert strain == pytest.approx(1e6 * (row.numbers[2] or 0.0), abs=5.0)
    heads = page.texts["histories"]
    assert "elongation, \u00b5m" in heads
    assert "strain, \u00b5m/m" in heads


def test_a_line_is_one_plot(page: Page) -> None:
    assert sum("along line across" in str(p["alt"]) for p in page.pictures()) == 1


def test_sections_logo_and_links_are_as_chosen(plate: Measurement, tmp_path: Path) -> None:
    logo = io.BytesIO()
    Image.new("RGB", (60, 20), "navy").save(logo, format="png")
    kept = plate.data / "report_logo.png"
    kept.write_bytes(logo.getvalue())
    try:
        answer = plate.client.get(plate.url, params={"sections": "not-stated,histories"})
        assert answer.status_code == 200, answer.text
        page = Page(answer.text)
        sections = [attributes["id"] for tag, attributes in page.tags if tag == "section"]
        assert sections == ["histories", "not-stated"]
        assert page.pictures()[0]["src"] == f"data:image/png;base64,{base64.b64encode(logo.getvalue()).decode()}"
        assert not any("map of" in str(picture["alt"]) for picture in page.pictures())
        # what is not stated does not depend on what is shown
        assert answer.headers["X-Not-Stated"] == str(len(page.missing()))
        refused = plate.client.get(plate.url, params={"sections": "fields,nonsense"})
        assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")
    finally:
        kept.unlink()
    drawing = tmp_path / "logo.svg"
    drawing.write_text('<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>')
    out = tmp_path / "r.html"
    chosen = ["--sections", "annex", "--logo", str(drawing), "--out", str(out)]
    assert main(["report", str(plate.data), *chosen]) == 0
    page = Page(out.read_text())
    assert [a["id"] for tag, a in page.tags if tag == "section"] == ["annex"]
    (only,) = page.pictures()
    assert str(only["src"]).startswith("data:image/svg+xml;base64,")
    assert json.loads(page.texts["settings"])["subset_px"] == 25


def test_the_report_tells_its_progress(plate: Measurement) -> None:
    seen: list[tuple[str, int, int]] = []
    options = ReportOptions(sections=("seen", "histories"))
    make_report(find_source(plate.data), options=options, progress=lambda *at: seen.append(at))
    assert seen == [*(("reading", n, 6) for n in range(6)), ("drawing", 0, 2), ("drawing", 1, 2)]


def test_pictures_are_pictures_with_a_bar_and_a_unit(page: Page) -> None:
    for attributes in page.pictures():
        kind, _, data = str(attributes["src"]).partition(";base64,")
        assert attributes["alt"]
        if kind == "data:image/png":
            with Image.open(io.BytesIO(base64.b64decode(data))) as image:
                assert min(image.size) > 250
                assert len(np.unique(np.asarray(image.convert("L")))) > 20
        else:
            assert kind == "data:image/svg+xml"
            assert b"<svg" in base64.b64decode(data)


def test_the_page_loads_nothing_from_elsewhere(answered: Answered, plate: Measurement) -> None:
    answer, page = answered.response, Page(answered.response.text)
    for tag, attributes in page.tags:
        assert tag not in {"script", "link", "iframe", "object", "embed", "base", "form"}, tag
        assert not any(name.startswith("on") for name in attributes), attributes
        assert "style" not in attributes
        for name in ("src", "href", "srcset", "action", "data", "poster", "background"):
            value = attributes.get(name)
            if tag == "a" and value is not None:  # loads nothing by itself
                assert value.endswith(f"/#/test/{plate.test_id}")
                continue
            assert value is None or value.startswith(("data:image/", "#")), (tag, name, str(value)[:80])
    assert "url(" not in page.style
    assert "@import" not in page.style
    assert "http" not in page.style
    digest = base64.b64encode(hashlib.sha256(page.style.encode()).digest()).decode()
    for policy in (page.policy, answer.headers["content-security-policy"]):
        assert f"'sha256-{digest}'" in policy
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
    assert answer.headers["content-type"] == "text/html; charset=utf-8"


def test_names_and_labels_cannot_bring_markup_in(page: Page) -> None:
    tags = {tag for tag, _ in page.tags}
    assert not tags & {"script", "i"}
    assert "Smith" in page.rows["test.operator"].cells[1]
    assert page.rows["test.operator"].cells[1] == METADATA["operator"]
    assert page.rows["test.specimen"].cells[1] == "<img src=x onerror=alert(2)>"
    assert page.rows["step.3"].cells[1] == "<b>c</b>"
    assert page.heading == NASTY
    assert "</style>" not in page.style
    assert sum(tag == "style" for tag, _ in page.tags) == 1


def test_service_answers_while_a_report_is_made(answered: Answered) -> None:
    # drawing takes seconds; a service that drew itself would be silent for as long
    assert answered.slowest_s < 2.0


def test_no_report_without_results(plate: Measurement) -> None:
    gone = plate.client.get(f"{API}/tests/{plate.test_id}/analyses/a000099-000000/report")
    assert (gone.status_code, gone.json()["code"]) == (404, "not_found")


def test_command_line_on_a_data_folder_and_what_is_missing_is_listed(
    plate: Measurement, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "facts.toml"
    file.write_text('operator = "Somebody else"\nstatic_steps = []\n[cam1]\nmaker = "B"\nlens = { f_number = 8 }\n')
    copy = tmp_path / "data"
    shutil.copytree(plate.data / "tests", copy / "tests")
    out = tmp_path / "new" / "report.html"
    assert main(["report", str(copy), "--facts", str(file), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    page = Page(out.read_text())
    assert page.rows["test.operator"].cells[1] == "Somebody else"
    assert page.rows["lens.aperture"].numbers[1:3] == [8.0, None]
    missing = page.missing()
    for name in (
        "Lens, maker",
        "Lens, focal length",
        "Lens, aperture, cam2",
        "Lighting",
        "Patterning technique",
        "Pixel size",
        "Camera, maker, cam2",
        "Material",
        "Gauges",
        "Noise floor and bias of displacement and strain, from static steps",
    ):
        assert name in missing, (name, missing)
        assert f"  {name}: " in printed
    assert "Camera, maker, cam1" not in missing
    assert "Operator" not in missing
    # an item without a statement is in the list alone
    assert not page.rows.keys() & {"lens.maker", "lighting", "test.material"}
    assert any("not stated" in cell for cell in page.rows["floor.W"].cells)
    assert not any(tag == "a" for tag, _ in page.tags)  # no service is known whose form could be linked
    # the points' own values are reported beside it all the same
    assert page.rows["floor.W"].numbers[5] is not None
    # each item that is not stated in the tables is in the list
    for key, row in page.rows.items():
        if key.startswith(("camera.", "lens.", "pattern.", "test.")) and "not stated" in row.cells[1]:
            assert any(name.startswith(row.cells[0]) for name in missing), row.cells
    # the test's own folder and the analysis' are as good; metadata are those kept with the test
    test = copy / "tests" / plate.test_id
    for path in (copy, test, test / "analyses" / plate.analysis_id):
        source = find_source(path)
        assert (list(source.files), source.metadata.operator) == (list(range(6)), METADATA["operator"])
        assert not source.stale


def test_static_steps_are_also_known_by_their_labels(plate: Measurement, tmp_path: Path) -> None:
    test = tmp_path / plate.test_id
    shutil.copytree(plate.data / "tests" / plate.test_id, test)
    for n in (1, 3):
        mark = test / "steps" / f"{n:04d}" / "step.json"
        mark.write_text(json.dumps(json.loads(mark.read_text()) | {"label": "Static, before loading"}))
    document = json.loads((test / "test.json").read_text())
    (test / "test.json").write_text(json.dumps({k: v for k, v in document.items() if k != "metadata"}))
    measured = read_steps(find_source(test))
    assert measured.static == [1, 3]
    assert "by their labels" in measured.static_source
    assert measured.floor["W"].bias is not None
    assert [step.static for step in measured.steps] == [False, True, False, True, False, False]


def test_results_of_files_without_a_rig(plate: Measurement, tmp_path: Path) -> None:
    steps = plate.data / "tests" / plate.test_id / "steps"
    for n, k in enumerate((0, 5)):
        for cam in ("cam1", "cam2"):
            shutil.copyfile(steps / f"{k:04d}" / f"{cam}.tif", tmp_path / f"{cam}_{n}.tif")
    calibration = json.loads(plate.service.tests.calibration_file(plate.test_id).read_text())
    # the eleven parameters alone, as from another program
    (tmp_path / "calibration.json").write_text(json.dumps({cam: calibration[cam] for cam in ("cam1", "cam2")}))
    assert (
        main(
            [
                "measure",
                "--cam1",
                str(tmp_path / "cam1_*.tif"),
                "--cam2",
                str(tmp_path / "cam2_*.tif"),
                "--calibration",
                str(tmp_path / "calibration.json"),
                "--roi",
                "70,70,150,150",
                "--subset",
                "25",
                "--patch",
                "affine",
                "--prefilter",
                "0.7",
                "--smooth",
                "5",
                "--strain",
                "off",
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    assert main(["report", str(tmp_path / "out"), "--out", str(tmp_path / "r.html")]) == 0
    page = Page((tmp_path / "r.html").read_text())
    assert reported_numbers(page, "stereo_angle")[0] == pytest.approx(59.9, abs=0.2)
    assert reported_numbers(page, "prefilter") == [0.7]
    assert reported_numbers(page, "smoothing") == [65.0]
    missing = page.missing()
    for name in ("Camera, model", "Exposure", "Image acquisition rate", "Load of the steps", "Images taken"):
        assert name in missing, missing
    assert any(name.startswith("Calibration checks") for name in missing)
    assert len(page.pictures()) >= 7
    assert "Calibration not included" in page.texts["uncertainty-sentence"]
    assert page.rows["budget.W"].cells[4:7] == ["not included"] * 3  # never zero
    assert "calibration not included" in page.texts["steps"]
    # without calibration and images, what needs them is missing and the rest is reported
    for path in [*tmp_path.glob("cam*.tif"), tmp_path / "calibration.json"]:
        path.unlink()
    assert main(["report", str(tmp_path / "out"), "--out", str(tmp_path / "r.html")]) == 0
    page = Page((tmp_path / "r.html").read_text())
    missing = page.missing()
    for name in (
        "Stereo angle",
        "Stand-off distance",
        "Image scale",
        "Pattern feature size",
        "Calibration record",
        "Reference image of camera 1",
    ):
        assert name in missing, missing
    assert reported_numbers(page, "subset") == [25.0]
    assert "= " not in page.rows["subset"].cells[1]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["nowhere"], "results_missing"),
        (["."], "results_missing"),
        ([".", "--sections", "fields,none"], "results_missing"),
        ([".", "--out", "r.pdf"], "output_unusable"),
        ([".", "--facts", "none.toml"], "file_missing"),
        ([".", "--test", "t000001-000000"], "option_conflict"),
    ],
)
def test_what_cannot_be_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], code: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["report", *arguments]) == 1
    assert capsys.readouterr().err.startswith(f"stereorig: {code}: ")
    assert not list(tmp_path.iterdir())
