"""config/bench_fake_gige.toml as described there: devices and doctor on real drivers, in a network of their own."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from stereorig.server.cli import main
from stereorig.server.doctor import AllChecks, Check
from stereorig.server.rig.devices import DeviceListing
from tests.support.requirements import ROOT, missing

CONFIG = ROOT / "config" / "bench_fake_gige.toml"
# root needs no user namespace, which containers often forbid
NETWORK = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--user", "--map-root-user", "--net"]

# the commands in the head of the rig file; the examination is one process, since each program takes seconds to start
SCRIPT = """
set -e
trap 'kill $(jobs -p) 2>/dev/null' EXIT
ip link set lo up
ip addr add 127.0.0.2/8 dev lo
setpriv --pdeathsig KILL arv-fake-gv-camera-0.8 -i 127.0.0.1 -s BENCH1 &
CAM1=$!
setpriv --pdeathsig KILL arv-fake-gv-camera-0.8 -i 127.0.0.2 -s BENCH2 &
setpriv --pdeathsig KILL "$PYTHON" -c 'from stereorig.server.cli import main; main(["simstage", "--port", "5301"])' &
"$PYTHON" -m tests.contract.devices.test_fake_gige_bench $CAM1
"""


def run(path: Path, *command: str) -> int:
    """Run a command of ours with its output in a file."""
    with path.open("w") as file, contextlib.redirect_stdout(file):
        return main([*command, "--json"])


def examine_all(out: Path, cam1: int) -> None:
    """Inside that network: look for devices and examine the bench, in all the ways that the tests need."""
    for _ in range(20):
        run(out / "devices.json", "devices")
        if (out / "devices.json").read_text().count("Aravis-Fake-BENCH") == 2:
            break
    doctor = ("doctor", "--data", str(out), "--seconds")
    status = run(out / "good.json", *doctor, "3", "--config", str(CONFIG), "--home", "--move")
    (out / "status").write_text(str(status))
    text = CONFIG.read_text()
    free, pulses = out / "free.toml", out / "pulses.toml"
    free.write_text(re.sub("(?m)^trigger = .*", 'trigger = "free"\nframe_rate_hz = 20.0', text))
    pulses.write_text(re.sub("(?m)^trigger = .*", 'trigger = "hardware"\ncapture_timeout_s = 1.0', text))
    run(out / "free.json", *doctor, "2", "--config", str(free))
    assert run(out / "pulses.json", *doctor, "1", "--config", str(pulses)) == 1
    serve = ["serve", "--config", str(CONFIG), "--data", str(out / "data"), "--port", "8000"]
    code = "import sys; from stereorig.server.cli import main; main(sys.argv[1:])"
    with subprocess.Popen(["setpriv", "--pdeathsig", "KILL", sys.executable, "-c", code, *serve]) as service:
        ask(str(out / "held.json"))
        run(out / "taken.json", "devices")
        busy = ("doctor", "--data", str(out / "data"), "--seconds", "1", "--config", str(CONFIG))
        assert run(out / "busy.json", *busy) == 1
        service.terminate()
    os.kill(cam1, signal.SIGKILL)
    assert run(out / "lost.json", *doctor, "1", "--config", str(CONFIG)) == 1


def ask(path: str) -> None:
    """Inside that network: wait for the service, ask it twice for its devices, and keep the second answer."""
    with httpx.Client(base_url="http://127.0.0.1:8000/api/v1", trust_env=False, timeout=30.0) as client:
        for _ in range(100):
            with contextlib.suppress(httpx.TransportError):
                if client.get("/rig").json()["connected"]:
                    break
            time.sleep(0.2)
        client.get("/devices")
        Path(path).write_text(client.get("/devices").text)
        assert client.get("/rig").json()["fault"] is None
        assert client.get("/cameras/cam1/frame").status_code == 200


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for program, package in (("arv-fake-gv-camera-0.8", "aravis-tools"), ("ip", "iproute2"), ("unshare", "util-linux")):
        if shutil.which(program) is None:
            missing(f"{program} (apt install {package})")
    try:
        import gi

        gi.require_version("Aravis", "0.8")
    except (ImportError, ValueError):
        missing("Aravis 0.8 for Python (apt install gir1.2-aravis-0.8, pip install 'stereorig[aravis]')")
    if subprocess.run([*NETWORK, "true"], capture_output=True, check=False).returncode:
        missing("the right to make a network namespace (unshare --net)")
    out = tmp_path_factory.mktemp("bench")
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHON": sys.executable, "OUT": str(out)}
    environment |= {"PYTHONPATH": str(ROOT), "HOME": str(out)}
    done = subprocess.run(
        [*NETWORK, "bash", "-c", SCRIPT],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def checks(path: Path) -> dict[tuple[str, str], Check]:
    report = AllChecks.model_validate_json(path.read_text())
    return {(check.part, check.name): check for check in report.checks}


def test_both_cameras_are_listed(found: Path) -> None:
    listing = DeviceListing.model_validate_json((found / "devices.json").read_text())
    cameras = {camera.serial: camera for camera in listing.cameras}
    assert cameras["BENCH1"].address == "127.0.0.1"
    assert cameras["BENCH2"].device == "Aravis-Fake-BENCH2"
    assert cameras["BENCH2"].problem is None
    assert {driver.name: driver.state for driver in listing.drivers}["aravis"] == "ok"


def test_the_bench_is_examined(found: Path) -> None:
    # frames may get lost between programs that share two processors; what does not depend on that must be good
    seen = checks(found / "good.json")
    sure = [("software", "driver aravis"), ("stage", "answers"), ("stage", "axis 1 move"), ("stage", "axis 2 homing")]
    for cam in ("cam1", "cam2"):
        sure += [(cam, "found"), (cam, "identity"), (cam, "settings"), (cam, "frame rate"), (cam, "image")]
    for key in sure:
        assert seen[key].state == "ok", seen[key]
    assert "BENCH2" in seen["cam2", "identity"].found
    # the fake camera checks for triggers 25 times a second
    assert 5.0 < (seen["cam1", "frame rate"].figures["rate_hz"] or 0.0) < 26.0
    assert (seen["cam1", "link"].figures["received_packets"] or 0) > 100
    assert seen["network", "lo"].figures["mtu"] == 65536
    account = seen["pairs", "account"].figures
    parts = ("paired", "unpaired", "incomplete", "dropped")
    assert account["triggered"] == sum(account[part] or 0 for part in parts)
    failed = [check for check in seen.values() if check.state == "failed"]
    assert (found / "status").read_text().strip() == ("1" if failed else "0")
    assert all(check.name in ("losses", "account", "skew") for check in failed), failed


def test_free_running_cameras_are_held_against_their_rate(found: Path) -> None:
    seen = checks(found / "free.json")
    for cam in ("cam1", "cam2"):
        rate = seen[cam, "frame rate"]
        assert rate.limit is not None
        assert rate.limit.startswith("20 Hz")
        assert rate.figures["wanted_hz"] == 20.0
    assert seen["disk", "writing"].limit is not None


def test_a_trigger_line_without_pulses_is_found_out(found: Path) -> None:
    seen = checks(found / "pulses.json")
    assert seen["cam1", "settings"].state == "ok"
    assert "trigger hardware" in seen["cam1", "settings"].found
    assert "no_frames" in seen["pairs", "frames"].found


def test_the_service_lists_what_it_holds_and_others_see_that_it_is_taken(found: Path) -> None:
    held = DeviceListing.model_validate_json((found / "held.json").read_text())
    assert {camera.serial: (camera.in_use_by, camera.problem) for camera in held.cameras} == {
        "BENCH1": ("cam1", None),
        "BENCH2": ("cam2", None),
    }
    taken = DeviceListing.model_validate_json((found / "taken.json").read_text())
    assert len(taken.cameras) == 2
    assert all("uses it" in (camera.problem or "") for camera in taken.cameras)


def test_a_bench_in_use_is_left_alone(found: Path) -> None:
    seen = checks(found / "busy.json")
    assert "camera_busy" in seen["cam1", "opening"].found
    assert seen["stage", "opening"].state == "not checked"
    assert seen["disk", "data folder"].state == "warning"
    assert not [key for key in seen if key[0] == "stage" and key[1] != "opening"]


def test_a_camera_that_is_off_is_told_apart_from_the_rest(found: Path) -> None:
    seen = checks(found / "lost.json")
    assert seen["cam1", "found"].state == "warning"
    assert "Aravis-Fake-BENCH2" in seen["cam1", "found"].found
    assert seen["cam1", "opening"].state == "failed"
    assert seen["cam2", "opening"].state == "ok"
    assert seen["cam2", "settings"].state == "ok"
    assert seen["stage", "answers"].state == "ok"
    assert seen["stage", "axis 1 move"].state == "not checked"
    assert json.loads((found / "lost.json").read_text())["good"] is False


if __name__ == "__main__":
    examine_all(Path(os.environ["OUT"]), int(sys.argv[1]))
