"""The demo's parts on fields of known truth, its client on scripted answers, and (slow) the whole of it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import MeasurementError, StateError
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.triangles import triangles_of
from stereorig.server.cli import main
from stereorig.server.cli.operation import demo
from stereorig.server.demo.calibration import ViewIntersections
from stereorig.server.demo.client import ServiceClient
from stereorig.server.demo.compare import compare_motion, compare_shape, heights_mm, pixel_mm
from stereorig.server.demo.drawing import fields as pictures
from stereorig.server.demo.experiments.plate import centre_deflection_um, fit_plate
from stereorig.server.demo.process import free_port, running_service
from stereorig.server.demo.session import DemoCheck, Outcome, table
from stereorig.server.formats.images import read_image
from stereorig.sim.plate import CircularPlate
from stereorig.sim.rig import SimRig
from tests.support.demo_field import field_of
from tests.support.requirements import ROOT

PRESSURES = [200.0, 400.0, 689.0]


def clamped(pressure_kpa: float, radius_mm: float, centre: tuple[float, float]) -> Callable[..., np.ndarray]:
    """Eq. (18) written out with the paper's numbers: w = q (a^2 - r^2)^2 / (64 D), towards the cameras."""
    D = 71.0e3 * 0.762**3 / (12.0 * (1.0 - 0.334**2))

    def w(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r2 = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
        return -pressure_kpa * 1e-3 * (radius_mm**2 - r2) ** 2 / (64.0 * D)

    return w


def test_the_plates_radius_and_centre_come_out_of_noisy_fields() -> None:
    fields = [field_of(clamped(q, 12.9, (0.3, -0.2)), noise_mm=0.3e-3, seed=k) for k, q in enumerate(PRESSURES)]
    fit = fit_plate(fields, PRESSURES, CircularPlate())
    # 2,500 points of 0.3 um against deflections of up to 100 um
    assert fit.radius_mm == pytest.approx(12.9, abs=0.003)
    np.testing.assert_allclose(fit.centre_mm, (0.3, -0.2), atol=0.01)
    D = 71.0e3 * 0.762**3 / (12.0 * (1.0 - 0.334**2))
    true_um = 1e3 * 0.689 * 12.9**4 / (64.0 * D)
    assert centre_deflection_um(fields[-1], fit.centre_mm) == pytest.approx(true_um, abs=0.15)  # three sigma of its fit


def test_failed_points_do_not_touch_the_fit() -> None:
    good = field_of(clamped(689.0, 12.9, (0.0, 0.0)))
    status = good.status.copy()
    status[5:9, 4:20] = 6
    uvw = np.where((status == 0)[..., None], good.uvw_mm, np.nan)  # type: ignore[arg-type]
    holed = dataclasses.replace(good, status=status, uvw_mm=uvw)
    assert fit_plate([holed], [689.0], CircularPlate()).radius_mm == pytest.approx(12.9, abs=1e-6)
    nothing = dataclasses.replace(good, status=np.ones_like(status))
    assert np.isnan(centre_deflection_um(nothing, (0.0, 0.0)))


def test_a_wrong_point_among_the_valid_is_found() -> None:
    rig = SimRig.from_toml(ROOT / "config" / "sim_paper.toml")
    flat = field_of(lambda x, y: np.zeros_like(x), noise_mm=0.2e-3)
    assert not compare_motion(flat, rig, "block", 0.0).wrong.any()
    uvw = np.array(flat.uvw_mm)
    uvw[3, 4, 1] += 0.2 * pixel_mm(rig)  # a fifth of a pixel: no match of this texture is that far off
    uvw[8, 9, 2] += 1.0
    status = flat.status.copy()
    status[8, 9] = 6  # wrong, but not shown as valid
    wrong = compare_motion(dataclasses.replace(flat, uvw_mm=uvw, status=status), rig, "block", 0.0).wrong
    assert np.argwhere(wrong).tolist() == [[3, 4]]


def test_a_wrong_height_is_found_though_the_frame_is_tilted() -> None:
    rig = SimRig.from_toml(ROOT / "config" / "sim_paper.toml")
    flat = field_of(lambda x, y: np.zeros_like(x))
    tilted = flat.xyz_mm.copy()
    tilted[..., 2] = 0.1 + 1e-3 * tilted[..., 0] - 2e-3 * tilted[..., 1]
    np.testing.assert_allclose(heights_mm(tilted, flat.valid), 0.0, atol=1e-12)
    assert not compare_shape(dataclasses.replace(flat, xyz_mm=tilted), rig, "block").any()
    tilted[6, 7, 2] += 0.05
    assert np.argwhere(compare_shape(dataclasses.replace(flat, xyz_mm=tilted), rig, "block")).tolist() == [[6, 7]]


def test_pictures_are_drawn_for_fields_with_holes(tmp_path: Path) -> None:
    rig = SimRig.from_toml(ROOT / "config" / "sim_paper.toml")
    one = field_of(clamped(689.0, 13.385, (0.0, 0.0)), noise_mm=0.2e-3)
    status = one.status.copy()
    status[:4, :4] = 1
    one = dataclasses.replace(one, status=status, uvw_mm=np.where((status == 0)[..., None], one.uvw_mm, np.nan))  # type: ignore[arg-type]
    comparison = compare_motion(one, rig, "plate", 689.0)
    image = np.zeros((480, 512), np.uint8)
    fit = fit_plate([one], [689.0], CircularPlate())
    found = pictures.plate(tmp_path, image, (46, 30, 466, 450), [one], [comparison], [689.0], CircularPlate(), fit)
    found |= pictures.panel(tmp_path, image, (46, 30, 466, 450), [one], [comparison], [1.0])
    heights = heights_mm(one.xyz_mm, one.valid)
    found |= pictures.steel(tmp_path, image, (46, 30, 466, 450), one, heights, heights)
    view = ViewIntersections("cam1", True, np.ones((3, 2)), np.ones((3, 2)))
    found |= pictures.calibration(tmp_path, [view])
    assert len(found) == 9
    for name in found:
        assert (tmp_path / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_missed_limit_fails_the_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = Outcome(
        checks=[DemoCheck("a", "um", 1.0, 1.2, -0.2, 0.5)], lines=["the table"], pictures={"a.png": "a picture"}
    )
    assert demo._finish(tmp_path, "plate", "title", outcome, 1.0) == 0
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is True
    for error in (0.6, float("nan")):
        outcome.checks = [DemoCheck("centre", "um", 1.0, 1.6, error, 0.5)]
        assert demo._finish(tmp_path, "plate", "title", outcome, 1.0) == 1
        err = capsys.readouterr().err
        assert err.startswith("stereorig: limit_missed: centre: ")
        assert " Remedy: " in err
        assert json.loads((tmp_path / "report.json").read_text())["passed"] is False


def test_tables_line_up() -> None:
    lines = table(["a", "bb"], [["1", "2"], ["333", "4"]])
    assert lines == ["  a  bb", "-------", "  1   2", "333   4"]


def client_of(answers: dict[str, Any], seen: list[str] | None = None) -> ServiceClient:
    def handle(request: httpx.Request) -> httpx.Response:
        key = f"{request.method} {request.url.path.removeprefix('/api/v1')}"
        if seen is not None:
            seen.append(key)
        answer = answers[key]
        if isinstance(answer, list):
            answer = answer.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer if isinstance(answer, httpx.Response) else httpx.Response(200, json=answer)

    return ServiceClient("http://x", transport=httpx.MockTransport(handle))


def test_a_problem_comes_back_with_its_code_and_remedy() -> None:
    problem = {"code": "hardware_busy", "detail": "The rig is held by job 7.", "remedy": "Wait."}
    with client_of({"GET /rig": httpx.Response(409, json=problem)}) as client, pytest.raises(StateError) as caught:
        client.get("/rig")
    assert (caught.value.code, caught.value.remedy) == ("hardware_busy", "Wait.")
    assert "held by job 7" in caught.value.cause
    with client_of({"GET /rig": httpx.Response(500, text="<html>")}) as client, pytest.raises(StateError) as caught:
        client.get("/rig")
    assert caught.value.code == "http_error"
    with client_of({"GET /rig": httpx.ConnectError("gone")}) as client, pytest.raises(StateError) as caught:
        client.get("/rig")
    assert caught.value.code == "service_lost"


def test_jobs_are_followed_to_their_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda _: None)
    job = {"id": "j1", "kind": "analysis", "progress": {"phase": "grow", "done": 1, "total": 4, "eta_s": 2.0}}
    states = [{**job, "state": s} for s in ("queued", "running", "succeeded")]
    seen: list[str] = []
    with client_of(
        {"POST /tests/t1/analyses": {"job": {"id": "j1"}, "analysis_id": "a1"}, "GET /jobs/j1": states}, seen
    ) as client:
        handle = client.analyse("t1", "profile", {"rectangle": [1, 2, 3, 4]}, subset_px=21)
    assert handle.analysis_id == "a1"
    assert seen.count("GET /jobs/j1") == 3
    failed = {**job, "state": "failed", "problem": {"code": "not_seeded", "detail": "Nothing.", "remedy": "Look."}}
    with client_of({"GET /jobs/j1": failed}) as client, pytest.raises(MeasurementError) as caught:
        client.wait("j1")
    assert (caught.value.code, caught.value.remedy) == ("not_seeded", "Look.")


def test_a_service_that_does_not_start_is_told_with_its_reason(tmp_path: Path) -> None:
    config = tmp_path / "rig.toml"
    config.write_text("[rig]\nname = 7\n")
    with pytest.raises(StateError) as caught, running_service(config, tmp_path / "data", tmp_path / "log"):
        pytest.fail("a broken rig file must not start")
    assert caught.value.code == "service_not_started"
    assert str(tmp_path / "log") in caught.value.remedy


def answers(port: int) -> bool:
    try:
        return httpx.get(f"http://127.0.0.1:{port}/api/v1/healthz", timeout=5.0, trust_env=False).is_success
    except httpx.TransportError:
        return False


def test_the_service_ends_with_the_block_whatever_ends_it(tmp_path: Path) -> None:
    config = demo.find_config("sim_paper.toml")
    with contextlib.suppress(ZeroDivisionError), running_service(config, tmp_path / "data", tmp_path / "log") as url:
        port = int(url.rsplit(":", 1)[1])
        assert answers(port)
        _ = 1 // 0
    assert not answers(port)


def test_ctrl_c_stops_the_service(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "stereorig.server.cli", "demo", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job ignores Ctrl-C, and so would its children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    port = None
    for line in process.stderr:
        if line.startswith("service: http://127.0.0.1:"):
            port = int(line.split(":")[3].split(",")[0])
            break
    assert port is not None
    assert answers(port)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    # a shell reports 130 for both; Python ends by the signal itself where it came while a string was executed
    assert process.returncode in (130, -signal.SIGINT)
    assert "stereorig: interrupted" in err
    assert "Traceback" not in err
    assert not answers(port)


def test_free_ports_are_free() -> None:
    assert not answers(free_port())


def test_no_triangle_of_a_picture_reaches_over_a_crack() -> None:
    field = field_of(lambda x, y: 0.0 * x)
    y = float(field.y_px[2, 0]) + 1.5
    line = [(float(field.x_px[0, 0]), y), (float(field.x_px[0, 3]), y)]
    rows, cols = field.shape
    x_px, y_px = field.x_px, field.y_px
    whole = {frozenset(t) for t in triangles_of(x_px, y_px, field.valid, None).tolist()}
    assert len(whole) == 2 * (rows - 1) * (cols - 1)
    cut = {frozenset(t) for t in triangles_of(x_px, y_px, field.valid, Cuts([line])).tolist()}
    gone = {k for t in whole - cut for k in t}
    # between rows 2 and 3 as far as the line goes; its end touches the next triangle's side in column 3
    assert gone == {2 * cols + c for c in range(5)} | {3 * cols + c for c in range(4)}


@pytest.mark.normal_depth("plate")
@pytest.mark.parametrize("experiment", ["plate", "steel", "panel"])
def test_every_experiment_keeps_its_limits(tmp_path: Path, experiment: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--experiment", experiment, "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["passed"]
    assert all(check["passed"] for check in report["checks"])
    wrong = [check for check in report["checks"] if check["name"].startswith("wrong points")]
    assert [check["found"] for check in wrong] == [0]
    assert set(report["pictures"]) == {path.name for path in tmp_path.glob("*.png")}
    assert "figures within their limits" in capsys.readouterr().out
    image = next((tmp_path / "data" / "tests").glob("*/steps/0000/cam1.tif"))
    assert read_image(image).shape == (480, 512)
