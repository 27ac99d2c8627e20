"""Cameras of `tests.support.timed_camera` behind the rig's own parts, inside a network namespace, as a program.

    unshare --net bash -c 'ip link set lo up; exec python -m tests.support.timed_rig NAME JSON'

NAME is a function of this module, JSON its arguments; prints its result as JSON.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.pairing import Pair
from stereorig.drivers.acquisition.sources import StreamedPairs
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.aravis.session import AravisGrabber
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, TriggerMode
from stereorig.server.config.rig_file import parse_config
from stereorig.server.rig import cameras
from stereorig.server.rig.build import first_settings, make_source, make_unit, new_action_keys
from stereorig.server.rig.cameras import CameraPair

ADDRESSES: dict[CameraName, str] = {"cam1": "127.0.0.1", "cam2": "127.0.0.2"}


class Devices:
    """The cameras' program; a call runs a line of Python in it and returns its answer."""

    def __init__(self, *options: dict[str, Any]) -> None:
        command = [sys.executable, "-m", "tests.support.timed_camera", json.dumps(options)]
        self._program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._program.stdout is not None
        assert self._program.stdout.readline().strip() == "ready"

    def __call__(self, line: str) -> Any:
        assert self._program.stdin is not None
        assert self._program.stdout is not None
        self._program.stdin.write(line + "\n")
        self._program.stdin.flush()
        return json.loads(self._program.stdout.readline())

    def end(self) -> None:
        self._program.kill()
        self._program.wait()


@contextlib.contextmanager
def rig(
    *options: dict[str, Any],
    trigger: TriggerMode = "hardware",
    rate_hz: float | None = None,
    max_skew_ms: float = 1.0,
    **camera: Any,
) -> Iterator[tuple[Devices, StreamedPairs, dict[CameraName, CameraUnit]]]:
    """Two cameras and the source of their pairs; without a rate a busy machine's pauses between pulses are no fault."""
    devices = Devices(*options)
    units: dict[CameraName, CameraUnit] = {}
    source = None
    try:
        if trigger == "hardware":
            devices(f"steady({rate_hz or 5.0})")
        for cam in CAMERAS:
            make = partial(AravisGrabber, CameraOptions(device=ADDRESSES[cam], **camera))
            units[cam] = CameraUnit(cam, make, trigger=trigger, rate_hz=rate_hz)
            units[cam].open(CameraSettings(exposure_ms=1.0))
        source = StreamedPairs(units, by="time", max_skew_ms=max_skew_ms, capture_timeout_s=5.0)
        source.start()
        yield devices, source, units
    finally:
        for unit in units.values():
            unit.release()
        if source is not None:
            source.stop()
        devices.end()


def shown(pair: Pair) -> dict[str, Any]:
    return {"ms": pair.skew_ms, "error_ms": pair.skew_uncertainty_ms, "by": pair.skew_source, "accepted": pair.accepted}


def skews(*, latch: bool, skews_ms: list[float], count: int = 10, max_skew_ms: float = 1.0) -> dict[str, Any]:
    """Return the pairs of each true skew, and the account; read-outs differ by 18 ms, clocks by 7 s and 50 ppm."""
    one = {"latch": latch, "readout_s": 0.002, "ppm": 20.0}
    two = {"latch": latch, "readout_s": 0.020, "ppm": -30.0, "offset_ns": 7_000_000_000}
    found: dict[str, Any] = {}
    with rig(one, two, max_skew_ms=max_skew_ms) as (devices, source, _):
        for skew_ms in skews_ms:
            devices(f"skewed({skew_ms})")
            time.sleep(1.0)  # the second look at the clocks
            after = source.newest(0)[0]
            for _ in range(6):  # frames under way, and as many pairs as a constant between the stamps needs
                after = source.newest(after)[0]
            pairs: list[dict[str, Any]] = []
            found[str(skew_ms)] = pairs
            while len(pairs) < count:
                after, pair = source.newest(after)
                pairs.append(shown(pair))
        found["account"] = source.account().as_dict()
    return found


def ptp(masters: list[int]) -> list[str]:
    """Return the source of the skew before and after the cameras, open and listening, follow their masters."""
    with rig({}, {}, ptp=True) as (devices, source, units):
        devices("[cam.ptp('Listening', 0) for cam in cams]")
        time.sleep(2.0)
        before = source.newest(0)[1].skew_source
        devices(f"[cam.ptp('Slave', master) for cam, master in zip(cams, {masters})]")
        time.sleep(2.5)
        return [before, source.newest(source.newest(0)[0])[1].skew_source, units["cam2"].description.clock]


_RIG = """
[rig]
name = "timed"
kind = "real"
max_skew_ms = 1000.0
{rig}
[cam1]
driver = "aravis"
device = "127.0.0.1"
image_size_px = [64, 64]
phd_px = 1000.0
exposure_ms = 1.0
{camera}
{cam1}
[cam2]
driver = "aravis"
device = "127.0.0.2"
image_size_px = [64, 64]
phd_px = 1000.0
exposure_ms = 1.0
{camera}
[stage]
driver = "esp301"
url = "sim"
soft_limits_mm = [-5.0, 5.0]
[target]
pitch_mm = 1.0
lines = [11, 11]
line_width_mm = 0.03
node_tolerance_mm = 0.001
[calibration]
moves = "free"
"""


@contextlib.contextmanager
def configured(
    *options: dict[str, Any], rig: str, cam1: str = "", camera: str = "", before: str = "0"
) -> Iterator[tuple[Devices, CameraPair]]:
    """The cameras as a rig file with these lines describes them; ``before`` is run in the devices before they open."""
    config = parse_config(_RIG.format(rig=rig, cam1=cam1, camera=camera))
    devices = Devices(*options)
    units: dict[CameraName, CameraUnit] = {}
    pair = None
    try:
        devices(before)
        keys = new_action_keys()
        for cam in CAMERAS:
            units[cam] = make_unit(config, cam, action_keys=keys)
            units[cam].open(first_settings(config, cam))
        source = partial(make_source, config, units, keys)
        pair = CameraPair(units["cam1"], units["cam2"], make_source=source, ptp=config.cam1.ptp)
        pair.start()
        time.sleep(2.5)  # the clocks are known
        yield devices, pair
    finally:
        for unit in units.values():
            unit.release()
        if pair is not None:
            pair.close()
        devices.end()


def first_capture(master: int | None, wait_s: float) -> list[str]:
    """Return the source of the first skew of cameras that follow a master late, or never, and the warnings."""
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("stereorig.rig").addHandler(handler)
    cameras.PTP_S = 2.5 + wait_s
    late = {"camera": "ptp = true", "before": "[cam.ptp('Listening', 0) for cam in cams]"}
    with configured({}, {}, rig='trigger = "software"', **late) as (devices, pair):
        if master is not None:
            devices(f"threading.Timer(0.5, lambda: [cam.ptp('Slave', {master}) for cam in cams]).start()")
        return [str(pair.capture().skew["skew_source"]), *said]


def captures(*options: dict[str, Any], count: int = 6, **lines: Any) -> dict[str, Any]:
    """Return pairs captured one after the other, or the codes of errors; the cameras' answers and strobe line."""
    with configured(*options, **lines) as (devices, pair):
        found: list[dict[str, Any] | str] = []
        for _ in range(count):
            try:
                found.append(pair.capture().skew)
            except CameraError as error:
                found.append(str(error.code))
        strobe = devices("[[cam.get(n) for n in ('LineSelector', 'LineMode', 'LineSource')] for cam in cams]")
        answers = [dict(unit.commands) for unit in pair.units.values()]
        return {"captures": found, "answers": answers, "strobe": strobe, "true": devices("[c.exposed for c in cams]")}


def many(*options: dict[str, Any], count: int, **lines: Any) -> dict[str, Any]:
    """Return the account of many commands, of which some and some of whose frames are lost, and the true one."""
    with configured(*options, **lines) as (devices, pair):
        codes: Counter[str] = Counter()
        for _ in range(count):
            try:
                pair.capture()
                codes["captured"] += 1
            except CameraError as error:
                codes[str(error.code)] += 1
        answers = [dict(unit.commands) for unit in pair.units.values()]
        one, two = (set(numbers) for numbers in devices("[cam.delivered for cam in cams]"))
        pair.close()
        account = pair.account()
    sent = sum(answers[0].values())
    true = {"triggered": sent, "paired": len(one & two), "unpaired": len(one ^ two), "dropped": sent - len(one | two)}
    return {"account": account, "true": true, "codes": codes, "answers": answers}


def witnessed(*options: dict[str, Any], file: str, **lines: Any) -> dict[str, Any]:
    """Capture as `captures`, and return every packet of action commands as tshark reads it from the wire."""
    shark = ["tshark", "-i", "lo", "-f", "udp port 3956", "-w", file]
    with subprocess.Popen(shark, stderr=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None
        while "Capturing on" not in program.stderr.readline():
            pass
        found = captures(*options, **lines)
        time.sleep(1.0)
        program.terminate()
    names = ["ip.src", "ip.dst", "gvcp.cmd.command", "gvcp.ack", "gvcp.cmd.req_id", "gvcp.cmd.flags", "gvcp.cmd.status"]
    names += [f"gvcp.cmd.action.{name}" for name in ("devicekey", "groupkey", "groupmask", "time")] + ["_ws.malformed"]
    fields = [part for name in names for part in ("-e", name)]
    only = "gvcp.cmd.command == 0x0100 || gvcp.ack == 0x0101"
    read = ["tshark", "-r", file, "-Y", only, "-T", "fields", "-E", "separator=;", *fields]
    rows = subprocess.run(read, capture_output=True, text=True, check=True).stdout.splitlines()
    return {
        **found,
        "packets": [dict(zip((n.rpartition(".")[2] for n in names), row.split(";"), strict=True)) for row in rows],
    }


if __name__ == "__main__":
    given = json.loads(sys.argv[2])
    print(json.dumps(globals()[sys.argv[1]](*given.pop("cameras", []), **given)), flush=True)
    os._exit(0)  # Aravis' threads do not wait for each other
