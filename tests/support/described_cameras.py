"""A GigE Vision camera that serves any GenICam description, and the driver in front of it, as a program of its own.

    unshare --net bash -c 'ip link set lo up; exec python -m tests.support.described_cameras DEVICES FILE.xml ...'

DEVICES is the folder with the device's program (``bench.py``). Prints a line of JSON for each description: its formats,
ranges, and the frames of each trigger mode. Of a rig file (``.toml``): what came of the settings of its cameras, on
one that has their features and a thermometer.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.cameras.aravis import discover
from stereorig.drivers.cameras.aravis.session import AravisGrabber
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FrameGrabber, LatchingGrabber, TriggerMode
from stereorig.server.config.rig_file import RigConfig, load_config
from stereorig.server.rig import build

ADDRESS, PORT, LINE = "127.0.0.1", 5400, "Line1"
_PULSES = 5
CLOCK = 0x1122334455667788


class Device:
    """The camera's program; a call runs a line of Python in it and returns its answer."""

    def __init__(self, devices: Path, description: Path, setup: str = "", size: tuple[int, int] = (640, 480)) -> None:
        # sizes as a camera has them; a maker's name in no known encoding
        sizes = f"[(c.set('Width', {size[0]}), c.set('Height', {size[1]})) for c in cams]"
        command = [
            sys.executable,
            str(devices / "bench.py"),
            str(description),
            str(PORT),
            "[{}, {}]",
            f"{sizes}\n{setup}",
        ]
        self._program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._program.stdout is not None
        assert self._program.stdout.readline().strip() == "ready"
        self._link = socket.create_connection(("127.0.0.1", PORT))
        self._lines = self._link.makefile("rw")

    def __call__(self, line: str) -> str:
        self._lines.write(line + "\n")
        self._lines.flush()
        return self._lines.readline().strip()

    def end(self) -> None:
        self._lines.close()
        self._link.close()
        self._program.kill()
        self._program.wait()


@contextlib.contextmanager
def opened(device: str) -> Iterator[FrameGrabber]:
    grabber = AravisGrabber(CameraOptions(device=device, trigger_source=LINE))
    try:
        grabber.open()
        yield grabber
    finally:
        grabber.close()


def frames(grabber: FrameGrabber, most: int, wait_s: float = 3.0) -> int:
    """Return how many frames come, waiting for each of them so long."""
    count = 0
    while count < most and grabber.next_frame(wait_s) is not None:
        count += 1
    return count


def frames_of(grabber: FrameGrabber, camera: Device, mode: TriggerMode) -> int | str:
    """Return how many frames three triggers make in a mode, or the error's code."""
    try:
        grabber.configure(CameraSettings(trigger=mode, frame_rate_hz=10.0 if mode == "free" else None, exposure_ms=5.0))
        grabber.arm()
        try:
            if mode == "free":
                return frames(grabber, _PULSES)
            count = 0
            for _ in range(_PULSES):
                grabber.trigger() if mode == "software" else camera(f"pulse({LINE!r})")
                count += frames(grabber, 1)
            return count
        finally:
            grabber.disarm()
    except CameraError as error:
        return str(error.code)


def look(devices: Path, description: Path) -> dict[str, Any]:
    """Open a camera of a description; set depths, trigger modes and a gain; return what came of each."""
    camera = Device(devices, description, "cams[0].mem.write(0x48, b'Kam\\xe9ra'.ljust(32, bytes(1)))")
    try:
        found: dict[str, Any] = {"listed": [one.extra["vendor"] for one in discover() if one.serial == "CAM1"]}
        with opened(ADDRESS) as grabber:
            known = grabber.describe()
            found |= {
                "gain": known.extra["gain"],
                "gain_range_db": known.gain_range_db,
                "packet": known.extra["packet_size_bytes"],
                "depths": {},
                "modes": {},
            }
            for depth in (8, 12):
                found["depths"][depth] = grabber.configure(CameraSettings(bit_depth=depth)).bit_depth
            for mode in ("free", "software", "hardware", "free"):
                found["modes"].setdefault(mode, []).append(frames_of(grabber, camera, mode))
            before = grabber.configure(CameraSettings(trigger="free"))
            try:
                grabber.configure(CameraSettings(bit_depth=8, exposure_ms=1e9))
            except CameraError as error:
                found["refused"] = error.code
            found["kept"] = grabber.configure(CameraSettings()) == before
        found["clock"] = clock_of(camera)
        return found
    finally:
        camera.end()


# features of the laboratory's camera that the description of its kind does not have
_MORE = """<Boolean Name="GammaEnable"><pValue>Gamma_reg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>
<IntReg Name="Gamma_reg"><Address>0x30000</Address>{four}<Sign>Unsigned</Sign>{end}</IntReg>
<Enumeration Name="TemperatureSelector"><EnumEntry Name="Framegrabberboard" NameSpace="Standard"><Value>0</Value>
</EnumEntry><EnumEntry Name="Coreboard" NameSpace="Standard"><Value>2</Value></EnumEntry><pValue>Place_reg</pValue>
</Enumeration><IntReg Name="Place_reg"><Address>0x30008</Address>{four}<Sign>Unsigned</Sign>{end}</IntReg>
<Float Name="TemperatureAbs"><pValue>Warm_reg</pValue><Unit>C</Unit></Float>
<FloatReg Name="Warm_reg"><Address>0x30010</Address>{four}{end}</FloatReg>
<Port """.format(
    four="<Length>4</Length><AccessMode>RW</AccessMode><pPort>Device</pPort>", end="<Endianess>BigEndian</Endianess>"
)


def look_at_lab(devices: Path, rig: Path) -> dict[str, Any]:
    """Open each camera of a rig file, give it the file's settings, send pulses, and change its temperature."""
    config = load_config(rig)
    return {cam: _look_at(devices, config, cam) for cam in CAMERAS}


def _look_at(devices: Path, config: RigConfig, cam: CameraName) -> dict[str, Any]:
    section = config.camera(cam)
    own = config.model_copy(update={cam: section.model_copy(update={"device": ADDRESS})})
    text = (devices / "descriptions" / "sfnc1_raw.xml").read_text(encoding="utf-8")
    more = "".join(f"<pFeature>{name}</pFeature>" for name in ("GammaEnable", "TemperatureSelector", "TemperatureAbs"))
    text = text.replace("<pFeature>GainRaw<", f"{more}<pFeature>GainRaw<").replace("<Port ", _MORE)
    columns, rows = section.image_size_px
    text = text.replace("<Max>640</Max>", f"<Max>{columns}</Max>").replace("<Max>480</Max>", f"<Max>{rows}</Max>")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "lab.xml").write_text(text, encoding="utf-8")
        serial = f"cams[0].mem.write(0xd8, {(section.serial or '').encode()!r}.ljust(16, bytes(1)))"
        start = f"{serial}; cams[0].set('GammaEnable', True); cams[0].set('TemperatureAbs', 41.5)"
        camera = Device(devices, Path(folder) / "lab.xml", start, section.image_size_px)
        try:
            grabber = build._grabber(own, cam, None, None)
            assert isinstance(grabber, LatchingGrabber)
            grabber.open()
            try:
                warm = [grabber.describe().temperature_c, camera("cams[0].get('TemperatureSelector')")]
                for value in (42.25, 5000.0):
                    camera(f"cams[0].set('TemperatureAbs', {value})")
                    warm.append(grabber.renew_clock().temperature_c)
                read = grabber.configure(build.first_settings(own, cam))
                known = grabber.describe()
                grabber.arm()
                camera("pulse('Line1')")
                frame = grabber.next_frame(5.0)
                shape = None if frame is None else [*frame.pixels.shape, frame.bit_depth]
                packet = known.extra["packet_size_bytes"]
                return {**asdict(read), "serial": known.serial, "shape": shape, "packet": packet, "warm": warm}
            finally:
                grabber.close()
        finally:
            camera.end()


def clock_of(camera: Device) -> tuple[str, bool] | None:
    """Return the clock that the driver names once the camera follows a master, and whether it latched the clock's data.

    None if the camera has no IEEE 1588 clock.
    """
    numbers = ("GevIEEE1588ParentClockId", "GevIEEE1588ParentClockIdLatched")
    states = ("PtpStatus", "GevIEEE1588Status", "GevIEEE1588StatusLatched")
    camera(f"[cams[0].has(n) and cams[0].set(n, {CLOCK}) for n in {numbers}]")
    camera(f"[cams[0].has(n) and cams[0].set(n, 'Slave') for n in {states}]")
    grabber = AravisGrabber(CameraOptions(device=ADDRESS, trigger_source=LINE, ptp=True))
    try:
        grabber.open()
        return grabber.describe().clock, camera("cams[0].get('GevIEEE1588DataSetLatch_reg')") == "1"
    except CameraError as error:
        if error.code != "ptp_unsupported":
            raise
        return None
    finally:
        grabber.close()


if __name__ == "__main__":
    for name in sys.argv[2:]:
        of_file = look_at_lab if name.endswith(".toml") else look
        print(json.dumps(of_file(Path(sys.argv[1]), Path(name))), flush=True)
    os._exit(0)  # Aravis' threads do not wait for each other
