"""The service with two GigE cameras on the wire and the simulated ESP301: calibration, load steps, a lost camera.

First Aravis' fake cameras as they are, whose pictures show no grid; then the same drivers with the simulated world's.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.sim.rig import SimRig
from tests.support.namespace import Namespace, NamespaceTransport, namespaces_missing
from tests.support.patience import Deadline
from tests.support.requirements import ROOT, missing
from tests.support.service_rig import SMALL, TINY, new_test, wait_for_job

API = "/api/v1"
ADDRESSES = ("127.0.0.1", "127.0.0.2")


@pytest.fixture
def network() -> Iterator[Namespace]:
    lacking = namespaces_missing()
    if lacking is None and shutil.which("arv-fake-gv-camera-0.8") is None:
        lacking = "arv-fake-gv-camera-0.8 (apt-get install aravis-tools)"
    try:
        import gi

        gi.require_version("Aravis", "0.8")
    except (ImportError, ValueError):
        lacking = "PyGObject and Aravis (apt-get install gir1.2-aravis-0.8; pip install 'stereorig[aravis]')"
    if lacking is not None:
        missing(lacking)
    made = Namespace(f"gige{os.getpid()}", ADDRESSES[1:])
    yield made
    made.remove()


def bench_file(path: Path, text: str, devices: tuple[str, str], rig: str, size: tuple[int, int], stage: str) -> Path:
    """A rig file for two GigE cameras, made from a simulated rig's: the user's part of it stays."""
    text = text.split("[sim]")[0].replace('kind = "simulated"\nmax_skew_ms = 1.0', f'kind = "real"\n{rig}')
    for cam, device in zip(("cam1", "cam2"), devices, strict=True):
        text = text.replace(
            f"[{cam}]\n", f'[{cam}]\ndriver = "aravis"\ndevice = "{device}"\nregion_px = [0, 0, {size[0]}, {size[1]}]\n'
        )
    lines = [
        f"image_size_px = [{size[0]}, {size[1]}]" if line.startswith("image_size") else line
        for line in text.splitlines()
        if not line.startswith("gain_db")  # a fake camera's gain is not in decibels
    ]
    path.write_text("\n".join(lines).replace('url = "sim"', f'url = "{stage}"\nhome_at_start = true') + "\n")
    return path


@contextlib.contextmanager
def service(network: Namespace, config: Path, data: Path) -> Iterator[httpx.Client]:
    """`stereorig serve` inside the namespace; yields a client once its stage is homed."""
    command = network.command(
        sys.executable, "-m", "stereorig.server.cli", "serve", "--config", str(config), "--port", "0"
    )
    with (data.parent / "serve.log").open("w+") as log:
        process = subprocess.Popen(
            [*command, "--data", str(data)], cwd=ROOT, stdout=subprocess.PIPE, stderr=log, text=True
        )
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            url = next((word for word in line.split() if word.startswith("http://")), "")
            assert url, (line, (data.parent / "serve.log").read_text())
            with httpx.Client(base_url=url, timeout=60.0, transport=NamespaceTransport(network.name)) as client:
                _until(lambda: _ready(client), 60.0)
                yield client
        finally:
            process.terminate()
            process.wait(timeout=20)
            assert process.stdout is not None
            process.stdout.close()
    assert process.returncode == 0


def _ready(client: httpx.Client) -> bool:
    rig = client.get(f"{API}/rig").json()
    assert rig["fault"] is None or rig["fault"]["code"] == "not_connected", rig["fault"]
    return bool(rig["connected"]) and all(axis["state"] == "ready" for axis in rig["stage"]["axes"])


def _until(condition: Any, limit_s: float) -> float:
    begin, deadline = time.monotonic(), Deadline(limit_s)
    while not condition():
        assert deadline.left, f"waited {limit_s} s in vain"
        time.sleep(0.02)
    return time.monotonic() - begin


@contextlib.contextmanager
def fake_camera(network: Namespace, address: str, serial: str) -> Iterator[subprocess.Popen[bytes]]:
    """Aravis' fake camera on an address of the namespace."""
    process = subprocess.Popen(network.command("arv-fake-gv-camera-0.8", "-i", address, "-s", serial))
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_fake_cameras_end_in_a_clear_refusal_before_anything_moves(network: Namespace, tmp_path: Path) -> None:
    with (
        fake_camera(network, ADDRESSES[0], "BENCH-1"),
        fake_camera(network, ADDRESSES[1], "BENCH-2") as second,
        contextlib.ExitStack() as again,
    ):
        config = bench_file(
            tmp_path / "rig.toml",
            TINY,
            ("Aravis-Fake-BENCH-1", "BENCH-2"),
            'trigger = "free"\nframe_rate_hz = 20.0\nmax_skew_ms = 50.0',
            (512, 512),
            "sim",
        )
        with service(network, config, tmp_path / "data") as client:
            shown = client.get(f"{API}/cameras").json()["cameras"]
            assert [cam["device"]["serial"] for cam in shown] == ["BENCH-1", "BENCH-2"]
            accepted = client.post(f"{API}/calibrations", json={}).json()
            done = wait_for_job(client, accepted["job"])
            assert done["state"] == "failed"
            document = client.get(f"{API}/calibrations/{accepted['calibration_id']}").json()
            assert document["problem"]["code"].startswith(("grid", "target")), document["problem"]
            assert document["problem"]["remedy"]
            # refused at the first look: nothing has moved, both cameras' images are kept with the position read back
            taken = document["taken"]
            assert {view["camera"] for view in taken} == {"cam1", "cam2"}
            assert {view["role"] for view in taken} == {"first_look"}
            assert [view["dz_mm"] for view in taken] == pytest.approx([0.0, 0.0], abs=0.002)
            for view in taken:
                image = client.get(f"{API}/calibrations/{accepted['calibration_id']}/views/0/{view['camera']}")
                assert image.status_code == 200, image.text
            assert "way_back" not in document["problem"].get("context", {})
            test_id = new_test(client)
            for n in range(3):
                step = client.post(f"{API}/tests/{test_id}/steps", json={"load_n": 10.0 * n}).json()
                assert step["n"] == n
                assert step["image_size_px"]["cam1"] == [512, 512]
                assert abs(step["skew_ms"]) <= 50.0
            # a machine with other work may stop everything for a while: one round of three must hold the limits
            rounds = []
            for _ in range(3):
                fault_s, back_s, second = _lose_and_find(network, client, second, again)
                rounds.append(f"fault after {fault_s:.2f} s, connected {back_s:.2f} s after the camera's start")
                if fault_s < 1.0 and back_s < 3.0:
                    break
            print(rounds)
            assert fault_s < 1.0, rounds
            assert back_s < 3.0, rounds
            after = _step_of_a_camera_that_answers(client, test_id)
            assert after.is_success, after.text
            assert after.json()["n"] == 3
            pairs = client.get(f"{API}/cameras/cam1/stats").json()["pairs"]
            assert pairs["triggered"] == sum(pairs[name] for name in ("paired", "unpaired", "incomplete", "dropped"))


def _lose_and_find(
    network: Namespace, client: httpx.Client, process: subprocess.Popen[bytes], again: contextlib.ExitStack
) -> tuple[float, float, subprocess.Popen[bytes]]:
    """Kill camera 2 and start it again: how long until that is shown, and until it works with the settings it had."""
    client.patch(f"{API}/cameras/cam2", json={"exposure_ms": 7.0}).raise_for_status()
    before = client.get(f"{API}/cameras/cam2").json()["reconnections"]

    def fault() -> dict[str, Any] | None:
        return client.get(f"{API}/cameras/cam2").json()["fault"]  # type: ignore[no-any-return]

    process.kill()
    process.wait()
    fault_s = _until(lambda: fault() is not None, 10.0)
    lost = fault()
    assert lost is not None
    assert lost["code"] == "camera_lost"
    process = again.enter_context(fake_camera(network, ADDRESSES[1], "BENCH-2"))
    back_s = _until(lambda: fault() is None, 20.0)
    shown = client.get(f"{API}/cameras/cam2").json()
    assert shown["settings"]["exposure_ms"] == pytest.approx(7.0)
    assert shown["reconnections"] > before
    return fault_s, back_s, process


def _step_of_a_camera_that_answers(client: httpx.Client, test_id: str) -> httpx.Response:
    """Capture a step; once more where a machine with other work let the camera be silent for the watchdog's 0.4 s."""
    answer = client.post(f"{API}/tests/{test_id}/steps", json={})
    if not answer.is_success and answer.json()["code"] == "camera_lost":
        _until(lambda: client.get(f"{API}/cameras/cam2").json()["fault"] is None, 20.0)
        answer = client.post(f"{API}/tests/{test_id}/steps", json={})
    return answer


def test_simulated_pictures_behind_the_same_drivers_end_in_a_calibration(network: Namespace, tmp_path: Path) -> None:
    sim_file = tmp_path / "sim.toml"
    sim_file.write_text(SMALL)
    truth = SimRig.from_dict(parse_config(SMALL).model_dump(exclude_none=True))
    world = subprocess.Popen(
        network.command(sys.executable, "-m", "tests.support.gige_sim", str(sim_file), *ADDRESSES),
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert world.stdin is not None
        assert world.stdout is not None
        stage = json.loads(world.stdout.readline())["stage"]
        # pictures are rendered while the stage settles
        settled = SMALL.replace("settle_ms = 0", "settle_ms = 2000")
        config = bench_file(
            tmp_path / "rig.toml", settled, ADDRESSES, 'trigger = "software"\nmax_skew_ms = 1000.0', (256, 240), stage
        )
        with service(network, config, tmp_path / "data") as client:
            accepted = client.post(f"{API}/calibrations", json={"frames": 2}).json()
            done = wait_for_job(client, accepted["job"])
            assert done["state"] == "succeeded", done["problem"]
            found = client.get(f"{API}/calibrations/{accepted['calibration_id']}").json()
            assert found["verdict"]["level"] in ("good", "warning")
            assert found["provenance"]["cameras"]["cam2"]["serial"] == "WORLD-cam2"
            for cam in ("cam1", "cam2"):
                camera = truth.camera(cam).camera  # type: ignore[arg-type]
                true = camera.paper_parameters()["z0_mm"]
                assert found[cam]["z0_mm"] == pytest.approx(true, rel=0.01)
            test_id = new_test(client, calibration_id=accepted["calibration_id"])
            for load in (0.0, 400.0):
                world.stdin.write(json.dumps({"scene": "plate", "load": load}) + "\n")
                world.stdin.flush()
                assert json.loads(world.stdout.readline())["done"]
                client.post(f"{API}/tests/{test_id}/steps", json={"label": f"{load} kPa"}).raise_for_status()
            body = {"region": {"rectangle": [70, 70, 170, 160]}, "subset_px": 25, "spacing_px": 10}
            analysis = client.post(f"{API}/tests/{test_id}/analyses", json=body).json()
            done = wait_for_job(client, analysis["job"], 240.0)
            assert done["state"] == "succeeded", done["problem"]
            url = f"{API}/tests/{test_id}/analyses/{analysis['analysis_id']}/steps/1/fields/w_mm"
            w_mm = np.array(client.get(url, params={"format": "json"}).json()["values"], dtype=float)
            assert np.isfinite(w_mm).mean() > 0.9
            assert np.nanmax(np.abs(w_mm)) > 0.02
    finally:
        world.kill()
        world.communicate()
