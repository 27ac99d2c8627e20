"""Two GigE Vision cameras at the far end of one narrow link, behind the rig and the doctor, as a program.

    unshare --net --mount python -m tests.support.shared_link '[[FEATURE, FEATURE, LINE, LINE], ...]'

FEATURE is that by which a camera can be held back; LINE a line of the rig file for it, or empty. The link is a pair of
virtual interfaces: its far end lies in another namespace and sends 10 Mbit/s, with room for ten packets. Prints
a line of JSON: for each case, the shares, the packets that found no room, and the images that came whole. If no line is
given, the doctor looks too, and the images come at the highest rate that it promises; else by triggers for both.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from struct import pack
from typing import Any

from stereorig.core.names import CAMERAS
from stereorig.drivers.acquisition import reader
from stereorig.drivers.cameras.genicam import watch as genicam_watch
from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state
from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.server.config.rig_file import parse_config
from stereorig.server.doctor.cameras import watch
from stereorig.server.doctor.link import check_network
from stereorig.server.doctor.report import Notebook
from stereorig.server.rig.build import first_settings, open_devices
from tests.support import timed_camera, timed_rig
from tests.support.timed_camera import DESCRIPTION_AT, TimedCamera

SIDE = 256
MBIT = 10
HOST, ADDRESSES = "10.9.0.1", ("10.9.0.11", "10.9.0.12")
_MADE = {
    "DeviceLinkThroughputLimitMode": timed_camera._enumeration("DeviceLinkThroughputLimitMode", {"Off": 0, "On": 1}),
    **{
        name: timed_camera._integer(name)
        for name in ("DeviceLinkThroughputLimit", "StreamBytesPerSecond", "GevSCPD", "GevLinkSpeed")
    },
}


class HeldCamera(TimedCamera):
    """A camera that sends no faster than one of its features lets it, however late its program is.

    Of the rates in bytes a second it counts the image's bytes alone, which loads the link most.
    """

    def __init__(self, own: str, serial: str, feature: str) -> None:
        super().__init__(own, serial)
        self._feature = feature
        self._busy = threading.Lock()
        names = [name for name in _MADE if name.startswith(feature)]
        names += ["GevLinkSpeed"] if feature == "GevSCPD" else []
        xml = timed_camera._xml(latch=True).decode().replace("<Max>64</Max>", f"<Max>{SIDE}</Max>")
        for name in names:
            xml = xml.replace("</Category>", f"<pFeature>{name}</pFeature></Category>", 1)
            xml = xml.replace("<Port ", f"{_MADE[name]}<Port ", 1)
        self._mem[DESCRIPTION_AT : DESCRIPTION_AT + len(xml)] = xml.encode()
        place = f"Local:c.xml;{DESCRIPTION_AT:X};{len(xml):X}\0".encode()
        self._mem[0x200 : 0x200 + len(place)] = place
        for name, value in {"Width": SIDE, "Height": SIDE, "PayloadSize": SIDE * SIDE, "GevLinkSpeed": MBIT}.items():
            self.set(name, value)
        for name in ("DeviceLinkThroughputLimit", "StreamBytesPerSecond"):
            self.set(name, MBIT * 125_000)

    def _packet_s(self, packet: bytes) -> float:
        wire_s = (len(packet) + 66) * 8e-6 / MBIT
        if self._feature == "GevSCPD":
            return wire_s + self.get("GevSCPD") / 1e9
        mode = self.get("DeviceLinkThroughputLimitMode") == 1 or self._feature == "StreamBytesPerSecond"
        return max(wire_s, len(packet) / self.get(self._feature)) if mode else wire_s

    def _expose(self, number: int, begin_ns: int, command: int) -> None:
        with self._busy:
            super()._expose(number, begin_ns, command)

    def expose_at(self, begin_ns: int, command: int = 0) -> None:
        if not self._busy.locked():  # a camera that still sends ignores what would start another image
            super().expose_at(begin_ns, command)

    def _packets(self, number: int, stamp: int) -> Iterator[bytes]:
        for packet in _gvsp(number, stamp, int.from_bytes(self._mem[0xD06:0xD08], "big") - 36):
            yield packet
            time.sleep(self._packet_s(packet))


def _gvsp(number: int, stamp: int, step: int) -> Iterator[bytes]:
    yield pack(">HHI", 0, number, 1 << 24) + pack(">HHQIIIIIHH", 0, 1, stamp, 0x01080001, SIDE, SIDE, 0, 0, 0, 0)
    pixels = bytes((number + k) % 251 for k in range(SIDE * SIDE))
    blocks = [pixels[k : k + step] for k in range(0, len(pixels), step)]
    for k, block in enumerate(blocks, 1):
        yield pack(">HHI", 0, number, 3 << 24 | k) + block
    yield pack(">HHIHHI", 0, number, 2 << 24 | len(blocks) + 1, 0, 1, SIDE)


def _run(*lines: str) -> None:
    for line in lines:
        subprocess.run(line.split(), check=True, capture_output=True, text=True)


def cameras(*features: str) -> None:
    """Serve cameras in this program's own namespace; answer each line of standard input by the packets dropped."""
    print("here", flush=True)
    sys.stdin.readline()  # the link is here
    _run("ip link set lo up", *(f"ip addr add {own}/24 dev far" for own in ADDRESSES), "ip link set far up")
    _run(f"tc qdisc add dev far root tbf rate {MBIT}mbit burst 3100 limit 15140")
    for k, (own, feature) in enumerate(zip(ADDRESSES, features, strict=True), 1):
        HeldCamera(own, f"HELD{k}", feature).start()
    print("ready", flush=True)
    for _ in sys.stdin:
        words = ["tc", "-s", "qdisc", "show", "dev", "far"]
        shown = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        print(re.findall(r"dropped ([0-9]+)", shown)[0], flush=True)


def case(features: tuple[str, str], lines: tuple[str, str]) -> dict[str, Any]:
    """Open a rig on such cameras and count."""
    trigger = 'trigger = "software"' if any(lines) else 'trigger = "free"\nframe_rate_hz = 3.0'
    text = timed_rig._RIG.format(rig=trigger, camera="", cam1=lines[0])
    text = text.replace("[stage]", f"{lines[1]}\n[stage]").replace("[64, 64]", f"[{SIDE}, {SIDE}]")
    for own, other in zip(timed_rig.ADDRESSES.values(), ADDRESSES, strict=True):
        text = text.replace(f'"{own}"', f'"{other}"')
    config = parse_config(text)
    command = ["unshare", "--net", sys.executable, "-m", "tests.support.shared_link", "cameras", *features]
    far = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
    asked, answers = far.stdin, far.stdout
    assert asked is not None
    assert answers is not None

    def dropped() -> int:
        asked.write("\n")
        return int(answers.readline())

    with far, tempfile.TemporaryDirectory() as folder:
        try:
            assert answers.readline() == "here\n"
            _run("ip link add near type veth peer name far", f"ip link set far netns {far.pid}")
            _run(f"ip addr add {HOST}/24 dev near", "ip link set near up")
            asked.write("\n")
            assert answers.readline() == "ready\n"
            # a virtual interface calls itself faster than the link behind it
            (Path(folder) / "speed").write_text(f"{MBIT}\n")
            _run(f"mount --bind {folder}/speed /sys/class/net/near/speed")
            while ControlState.SILENT in map(control_state, ADDRESSES):
                pass  # a new interface sends nothing for up to a second
            devices = open_devices(config, {cam: first_settings(config, cam) for cam in CAMERAS})
            try:
                before = dropped()  # of the moment at which the second camera was not held back yet
                units = devices.pair.units
                found: dict[str, Any] = {cam: units[cam].description.extra.get("link_share") for cam in CAMERAS}
                if not any(lines):
                    book = Notebook()
                    check_network(book, units, watch(devices.pair, 2.0))
                    check = next(check for check in book.checks if check.name == "near")
                    found |= {"said": check.found, "rate_hz": check.figures["safe_rate_hz"]}
                    for cam in CAMERAS:
                        devices.pair.configure(cam, CameraSettings(frame_rate_hz=found["rate_hz"]))
                for _ in range(20):
                    for unit in units.values() if any(lines) else ():
                        unit.reader.trigger()
                    time.sleep(0.2)
                counts = [units[cam].counters() for cam in CAMERAS]
                images = [count["delivered"] + count["overrun"] for count in counts]
                return {**found, "dropped": dropped() - before, "images": images}
            finally:
                devices.close()
        finally:
            far.kill()
            subprocess.run(["umount", "/sys/class/net/near/speed"], check=False)
            subprocess.run(["ip", "link", "del", "near"], check=False)


if __name__ == "__main__":
    if sys.argv[1] == "cameras":
        cameras(*sys.argv[2:])
    else:
        # a busy machine's cameras are late, and no camera is lost
        reader._MIN_PATIENCE_S = genicam_watch._PATIENCE_S = 30.0
        _run("mount -t sysfs sysfs /sys", "ip link set lo up")
        found = [case((one, two), (first, second)) for one, two, first, second in json.loads(sys.argv[1])]
        print(json.dumps(found), flush=True)
        os._exit(0)  # Aravis' threads do not wait for each other
