"""`stereorig devices`, `GET /devices`: what is found, what is wrong with it, and a search that disturbs no program."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import FoundDevice
from stereorig.drivers.registry import open_stage
from stereorig.drivers.stages import serial_ports
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_ports import discover_ports, port_problem
from stereorig.server.cli import main
from stereorig.server.cli.operation.devices import report
from stereorig.server.rig.devices import DeviceFinder, DeviceListing, HeldDevice
from stereorig.server.workflows.service import Service
from tests.support.requirements import ROOT
from tests.support.service_rig import served, wait_for_rig

API = "/api/v1"
GOOD = FoundDevice(
    kind="camera", driver="good", device="Maker-Model-1", model="Maker Model", serial="1", address="10.0.0.2"
)


def finder(**looks: object) -> DeviceFinder:
    def discover(driver: str) -> list[FoundDevice]:
        return looks[driver]()  # type: ignore[operator,no-any-return]

    return DeviceFinder(looks, discover=discover, ports=list)


def missing() -> list[FoundDevice]:
    raise CameraError("PyGObject is not installed.", code="driver_missing", remedy="pip install 'stereorig[aravis]'.")


def states(listing: DeviceListing) -> dict[str, str]:
    return {driver.name: driver.state for driver in listing.drivers}


# searching ------------------------------------------------------------------------------------------------------


def test_one_bad_driver_spoils_only_its_own_part() -> None:
    release = threading.Event()

    def hangs() -> list[FoundDevice]:
        release.wait(30)
        return []

    def breaks() -> list[FoundDevice]:
        raise RuntimeError("no such luck")

    def lacks() -> list[FoundDevice]:
        raise ModuleNotFoundError("No module named 'gi'")

    start = time.monotonic()
    found = finder(good=lambda: [GOOD], hangs=hangs, breaks=breaks, missing=missing, lacks=lacks).find(timeout_s=0.3)
    assert time.monotonic() - start < 5.0
    release.set()
    assert [camera.device for camera in found.cameras] == ["Maker-Model-1"]
    assert states(found) == {
        "breaks": "failed",
        "good": "ok",
        "hangs": "timeout",
        "lacks": "missing",
        "missing": "missing",
        "serial": "ok",
    }
    text = report(found)
    assert "missing: PyGObject is not installed. pip install 'stereorig[aravis]'." in text
    assert "RuntimeError: no such luck" in text
    assert "No module named 'gi'" in text


def test_a_search_that_hangs_is_not_started_again() -> None:
    calls = []
    release = threading.Event()

    def hangs() -> list[FoundDevice]:
        calls.append(1)
        release.wait(30)
        return [GOOD]

    search = finder(good=hangs)
    for _ in range(3):
        assert states(search.find(timeout_s=0.02))["good"] == "timeout"
    assert len(calls) == 1
    release.set()
    assert len(search.find(timeout_s=5.0).cameras) == 1


@pytest.mark.parametrize("named", ["Maker-Model-1", "10.0.0.2", "1", "by some other name"])
def test_our_own_camera_is_not_reported_as_taken(named: str) -> None:
    taken = FoundDevice(**{**vars(GOOD), "problem": "another program controls it"})
    other = FoundDevice(**{**vars(taken), "device": "Maker-Model-2", "serial": "2", "address": "10.0.0.3"})
    held = HeldDevice("cam2", "good", named, "Maker Model", "1")
    found = finder(good=lambda: [taken, other]).find(held=[held])
    assert [(camera.in_use_by, camera.problem) for camera in found.cameras] == [
        ("cam2", None),
        (None, "another program controls it"),
    ]


def test_a_held_camera_that_no_search_shows_is_listed_with_its_fault() -> None:
    held = HeldDevice("cam1", "good", "Maker-Model-1", "Maker Model", "1", problem="silent for 0.3 s")
    found = finder(good=list).find(held=[held])
    assert [(camera.device, camera.in_use_by, camera.problem) for camera in found.cameras] == [
        ("Maker-Model-1", "cam1", "silent for 0.3 s")
    ]


# serial ports ---------------------------------------------------------------------------------------------------


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A pty that the system's list shows as a USB adapter of Newport's."""
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    os.close(theirs)
    shown = SimpleNamespace(
        device=name,
        vid=0x104D,
        pid=0x3002,
        serial_number="A60",
        manufacturer="Newport",
        product="CONEX-CC",
        description="CONEX-CC",
    )
    monkeypatch.setattr(serial_ports.list_ports, "comports", lambda: [shown])
    yield name
    os.close(ours)


def test_a_free_port_is_listed_with_its_identity(port: str, tmp_path: Path) -> None:
    (tmp_path / "serial" / "by-id").mkdir(parents=True)
    link = tmp_path / "serial" / "by-id" / "usb-Newport_CONEX-CC_A60-if00-port0"
    link.symlink_to(port)
    (found,) = discover_ports(dev=tmp_path)
    assert (found.kind, found.device, found.model, found.serial, found.address) == (
        "serial",
        port,
        "Newport CONEX-CC",
        "A60",
        "104d:3002",
    )
    assert found.problem is None
    assert found.extra["link"] == str(link)
    assert "CONEX-CC" in found.extra["hint"]


def test_a_controller_whose_usb_port_has_no_driver_is_listed_with_the_way_that_works(tmp_path: Path) -> None:
    for name, product in (("1-1", "3001"), ("1-2", "3002"), ("1-0:1.0", None)):
        (tmp_path / name).mkdir()
        if product is not None:
            (tmp_path / name / "idVendor").write_text("104d\n")
            (tmp_path / name / "idProduct").write_text(f"{product}\n")
    found = [one for one in discover_ports(usb=tmp_path) if one.model == "Newport ESP301"]
    assert [(one.device, one.address) for one in found] == [("usb 1-1", "104d:3001")]
    assert "RS-232" in str(found[0].problem)


@pytest.mark.parametrize("how", ["open", "locked"])
def test_a_port_that_another_program_holds_names_it(port: str, how: str, tmp_path: Path) -> None:
    script = (
        "import os, sys, fcntl; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); "
        "fcntl.flock(f, fcntl.LOCK_EX) if sys.argv[2] == 'locked' else None; print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, port, how], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        proc = Path("/proc")
        if how == "locked":
            # as another user would see it: the table of locks, but no open files
            proc = tmp_path
            (proc / "locks").write_text(Path("/proc/locks").read_text())
            (proc / str(other.pid)).mkdir()
        problem = port_problem(port, proc=proc)
        other.communicate("\n")
    assert problem is not None
    assert f"process {other.pid}" in problem
    assert port_problem(port) is None


def test_our_own_hold_is_no_problem(port: str) -> None:
    ours = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(ours, fcntl.LOCK_EX)
        assert port_problem(port) is None
    finally:
        os.close(ours)


def test_a_lock_file_of_a_living_program_counts_and_a_stale_one_does_not(port: str, tmp_path: Path) -> None:
    lock = tmp_path / f"LCK..{Path(port).name}"
    lock.write_text(f"{os.getppid():>10}\n")
    assert f"process {os.getppid()}" in str(port_problem(port, locks=tmp_path))
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    lock.write_text(f"{dead.pid:>10}\n")
    assert port_problem(port, locks=tmp_path) is None


def test_a_console_of_the_kernel_is_no_line_for_a_stage(port: str, tmp_path: Path) -> None:
    (tmp_path / "consoles").write_text(f"{Path(port).name}                -W- (EC   a)    4:64\n")
    assert "console" in str(port_problem(port, proc=tmp_path))


def test_missing_rights_name_the_group_to_join(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    dialout = SimpleNamespace(gr_name="dialout", gr_mem=[])
    monkeypatch.setattr(serial_ports.grp, "getgrgid", lambda _: dialout)
    group_may = os.stat_result((0o020660, 0, 0, 0, 0, 424242, 0, 0, 0, 0))
    group_may_not = os.stat_result((0o020600, 0, 0, 0, 0, 424242, 0, 0, 0, 0))
    user = serial_ports.pwd.getpwuid(os.geteuid()).pw_name
    assert f"sudo usermod -aG dialout {user}" in serial_ports._no_access(group_may)
    assert "udev" in serial_ports._no_access(group_may_not)
    dialout.gr_mem = [user]
    assert "log out and in" in serial_ports._no_access(group_may)
    assert port_problem(port) is not None


def test_a_port_that_is_gone_says_so() -> None:
    assert "cannot be found" in str(port_problem("/dev/ttyNOSUCH7"))


# command line and service ---------------------------------------------------------------------------------------


def test_the_command_prints_a_table_and_the_services_json(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices"]) == 0
    text = capsys.readouterr().out
    assert "Cameras" in text
    assert port in text
    assert "104d:3002" in text
    assert main(["devices", "--json"]) == 0
    listing = DeviceListing.model_validate_json(capsys.readouterr().out)
    assert listing.serial_ports[0].device == port


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf"])
def test_a_time_limit_that_is_none_is_refused(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", f"--timeout={seconds}"]) == 1
    assert "invalid_input" in capsys.readouterr().err


def test_the_service_lists_its_own_cameras_and_goes_on_undisturbed(client: httpx.Client, port: str) -> None:
    before = client.get(f"{API}/cameras/cam1/stats").json()["frames"]
    listing = DeviceListing.model_validate(client.get(f"{API}/devices").json())
    ours = {camera.in_use_by: camera for camera in listing.cameras if camera.driver == "sim"}
    assert set(ours) == {"cam1", "cam2"}
    assert ours["cam1"].serial == "SIM-cam1"
    assert ours["cam1"].problem is None
    assert [p.device for p in listing.serial_ports] == [port]
    after = client.get(f"{API}/cameras/cam1/stats").json()["frames"]
    assert after["delivered"] >= before["delivered"]
    assert after["dropped"] == before["dropped"] == 0
    assert client.get(f"{API}/rig").json()["fault"] is None
    schema = json.loads(client.get(f"{API}/openapi.json").text)["components"]["schemas"]
    for name in ("DeviceListing", "ListedDevice", "DriverState"):
        assert schema[name]["additionalProperties"] is False
        assert all("description" in field for field in schema[name]["properties"].values())


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with served(service) as made:
        wait_for_rig(made)
        yield made


@pytest.mark.parametrize(("driver", "pty_too"), [("esp301", ()), ("smc100", ("--pty",))])
def test_a_simulated_controller_can_be_run_apart(driver: str, pty_too: tuple[str, ...]) -> None:
    code = "import sys; from stereorig.server.cli import main; sys.exit(main(sys.argv[1:]))"
    with subprocess.Popen(
        [sys.executable, "-c", code, "simstage", "--driver", driver, "--port", "0", *pty_too],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split('url = "')[1].split('"')[0]
            stage = open_stage(driver, url, {1: AxisOptions(), 2: AxisOptions()})
            try:
                assert stage.limits(2).controller_high_mm == pytest.approx(12.0)
            finally:
                stage.close()
        finally:
            process.send_signal(signal.SIGINT)
            try:
                assert process.wait(10) == 130
            finally:
                process.kill()


@pytest.mark.parametrize("options", [["--axes", "4"], ["--travel", "1", "5"], ["--port", "70000"]])
def test_a_controller_that_cannot_be_is_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simstage", *options]) == 1
    assert "Remedy" in capsys.readouterr().err
