"""Fake GigE cameras of aravis-tools, each at the end of a cable of its own: a network namespace and a veth pair.

The program at the other end knows nothing of this project. Its cable can be pulled, its network narrowed so that
packets are lost, and itself stopped, killed and started again.
"""

from __future__ import annotations

import atexit
import os
import random
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state
from tests.support.patience import Deadline

PROGRAM = "arv-fake-gv-camera-0.8"
_PREFIX = "srig"
_FULL_MTU = 1500
_START_S = 10.0
_FRAMES_LOST = ("ipproto", "udp", "sport", "3957-65534", "prohibit")


def what_is_missing() -> str | None:
    """What this machine lacks for fake cameras in namespaces, and how to get it."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
    except (ImportError, ValueError):
        return "PyGObject and Aravis 0.8 (apt install gir1.2-aravis-0.8, pip install 'stereorig[aravis]')"
    for program, package in ((PROGRAM, "aravis-tools"), ("ip", "iproute2"), ("setpriv", "util-linux")):
        if shutil.which(program) is None:
            return f"{program} (apt install {package})"
    if os.geteuid() != 0:
        return "the right to make network namespaces (run the tests as root)"
    probe = f"{_PREFIX}{os.getpid()}x"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"network namespaces (ip netns add: {made.stderr.strip()})"
    _ip("netns", "del", probe)
    return None


def _ip(*words: str, check: bool = True) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    assert not check or done.returncode == 0, f"ip {' '.join(words)}: {done.stderr}"
    return done.stdout


def fake_xml() -> str:
    """The description that the fake camera has built in."""
    import gi

    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis, Gio

    Aravis.get_n_interfaces()  # registers the library's resources
    data = Gio.resources_lookup_data("/org/aravis/arv-fake-camera.xml", Gio.ResourceLookupFlags.NONE)
    return bytes(data.get_data()).decode()


def small_sensor_xml(size: int = 512) -> str:
    """The same for a sensor of so many pixels a side, which is what the fake camera delivers when it is switched on.

    Its own is 2048 x 2048 px, of which it delivers 512 x 512.
    """
    xml = fake_xml()
    for axis in ("Width", "Height"):
        xml, found = re.subn(
            rf"<pValue>Sensor{axis}Register</pValue>", f"<Value>{size}</Value><AccessMode>RO</AccessMode>", xml
        )
        assert found == 1
    return xml


class FakeCamera:
    """One fake camera at its cable.

    Parameters
    ----------
    label
        Letters that no other camera of this process has; part of its serial number.
    xml
        Description of the camera, where it is not the fake camera's own.
    """

    def __init__(self, label: str, xml: str | None, folder: Path) -> None:
        _clean_up_after_others()
        self.serial = f"S{os.getpid()}{label}"
        self.device = f"Aravis-Fake-{self.serial}"
        self._space = f"{_PREFIX}{os.getpid()}{label}"
        self._cable = f"sr{os.getpid()}{label}"
        self._process: subprocess.Popen[bytes] | None = None
        self._arguments: list[str] = []
        if xml is not None:
            path = folder / f"{self.serial}.xml"
            path.write_text(xml)
            self._arguments = ["-g", str(path)]
        self._log = folder / f"{self.serial}.log"
        net = f"10.{random.randrange(192, 256)}.{random.randrange(256)}"
        self.address = f"{net}.2"
        atexit.register(self.end)
        _ip("netns", "add", self._space)
        _ip("link", "add", self._cable, "type", "veth", "peer", "name", "eth0", "netns", self._space)
        _ip("addr", "add", f"{net}.1/24", "dev", self._cable)
        _ip("-n", self._space, "addr", "add", f"{self.address}/24", "dev", "eth0")
        _ip("-n", self._space, "link", "set", "lo", "up")
        _ip("-n", self._space, "link", "set", "eth0", "up")
        self.plug()
        self.start()

    def start(self, *more: str) -> None:
        """Switch it on, with more arguments for the program; returns when it answers."""
        assert self._process is None
        command = ["setpriv", "--pdeathsig", "KILL", "ip", "netns", "exec", self._space]
        command += [PROGRAM, "-i", "eth0", "-s", self.serial, *self._arguments, *more]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self.await_answer()

    def await_answer(self) -> None:
        """Wait until it answers."""
        deadline = Deadline(_START_S)
        while control_state(self.address, timeout_s=0.05, attempts=1) is ControlState.SILENT:
            assert self._process is not None
            assert self._process.poll() is None, self._log.read_text()
            assert deadline.left, f"{self.serial} does not answer: {self._log.read_text()}"

    def kill(self) -> None:
        """Switch it off at once."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def stop(self) -> None:
        """It hangs."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)
        # the signal reaches one thread, which stops the others: on a busy machine another still answers meanwhile
        deadline = Deadline(_START_S)
        while not _all_threads_stopped(self._process.pid):
            assert deadline.left, f"{self.serial} does not stop"
            time.sleep(0.001)

    def resume(self) -> None:
        """It goes on where it was."""
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)

    @property
    def on(self) -> bool:
        """Whether its program runs."""
        return self._process is not None

    def unplug(self) -> None:
        """Pull its cable."""
        _ip("link", "set", self._cable, "down")

    def plug(self) -> None:
        """Put its cable back."""
        _ip("link", "set", self._cable, "up")

    def jumbo(self, mtu: int = 9000) -> None:
        """Let longer packets pass than usual."""
        _ip("link", "set", self._cable, "mtu", str(mtu))
        _ip("-n", self._space, "link", "set", "eth0", "mtu", str(mtu))

    def mute(self) -> None:
        """Let the network lose whole frames, and nothing else: what is sent from a port that is not for commands."""
        _ip("-n", self._space, "rule", "add", *_FRAMES_LOST)

    def unmute(self) -> None:
        """Let frames pass again; nothing to do if they do."""
        _ip("-n", self._space, "rule", "del", *_FRAMES_LOST, check=False)

    def narrow(self, mtu: int = 400) -> None:
        """Let the network lose every packet that is longer: image data, but neither commands nor a frame's header."""
        _ip("link", "set", self._cable, "mtu", str(mtu))

    def widen(self) -> None:
        """Let everything pass again that usually does."""
        self.jumbo(_FULL_MTU)

    def end(self) -> None:
        """Take everything away."""
        self.kill()
        _ip("link", "del", self._cable, check=False)
        _ip("netns", "del", self._space, check=False)
        atexit.unregister(self.end)


def _all_threads_stopped(pid: int) -> bool:
    """Whether no thread of a process runs any longer; the state follows the name in brackets."""
    states = [task.read_text().rpartition(")")[2].split()[0] for task in Path(f"/proc/{pid}/task").glob("*/stat")]
    return all(state == "T" for state in states)


def _clean_up_after_others() -> None:
    """Namespaces of test runs that were killed would stay for ever."""
    for line in _ip("netns", "list").splitlines():
        found = re.match(rf"({_PREFIX}(\d+)[a-z]+)\b", line)
        if found and not Path(f"/proc/{found[2]}").exists():
            _ip("netns", "del", found[1], check=False)


def settings_of(camera: FakeCamera) -> Mapping[str, str]:
    """Its part of a rig file."""
    return {"driver": "aravis", "device": camera.device, "trigger_source": "Line0"}


_MORE_FEATURES = """
    <Category Name="More" NameSpace="Custom">
        <pFeature>WidthMax</pFeature><pFeature>Gain</pFeature><pFeature>ExposureAuto</pFeature>
        <pFeature>PtpEnable</pFeature><pFeature>PtpStatus</pFeature><pFeature>PtpGrandmasterClockID</pFeature>
        <pFeature>Stepped</pFeature><pFeature>Held</pFeature><pFeature>TestBoolean</pFeature>
        <pFeature>DeviceReset</pFeature>
    </Category>
    <Integer Name="WidthMax" NameSpace="Standard"><pValue>SensorWidth</pValue></Integer>
    <Float Name="Gain" NameSpace="Standard">
        <pValue>GainConverter</pValue><Min>0.0</Min><Max>24.0</Max><Unit>dB</Unit>
    </Float>
    <Converter Name="GainConverter" NameSpace="Custom">
        <FormulaTo>FROM * 10</FormulaTo><FormulaFrom>TO / 10.0</FormulaFrom><pValue>GainRawRegister</pValue>
    </Converter>
    <Enumeration Name="ExposureAuto" NameSpace="Standard">
        <EnumEntry Name="Off" NameSpace="Standard"><Value>0</Value></EnumEntry>
        <EnumEntry Name="Continuous" NameSpace="Standard"><Value>2</Value></EnumEntry>
        <pValue>Free1</pValue>
    </Enumeration>
    <Boolean Name="PtpEnable" NameSpace="Standard">
        <pValue>Free2</pValue><OnValue>1</OnValue><OffValue>0</OffValue>
    </Boolean>
    <Enumeration Name="PtpStatus" NameSpace="Standard">
        <EnumEntry Name="Listening" NameSpace="Standard"><Value>0</Value></EnumEntry>
        <EnumEntry Name="Slave" NameSpace="Standard"><Value>9</Value></EnumEntry>
        <pValue>Free3</pValue>
    </Enumeration>
    <Integer Name="PtpGrandmasterClockID" NameSpace="Standard"><Value>1311768467463790320</Value></Integer>
    <Integer Name="Stepped" NameSpace="Custom"><pValue>Free4</pValue><Min>8</Min><Max>80</Max><Inc>8</Inc></Integer>
    <Integer Name="Held" NameSpace="Custom"><pIsLocked>TestRegister</pIsLocked><pValue>Free5</pValue></Integer>
    <Command Name="DeviceReset" NameSpace="Standard"><pValue>Free6</pValue><CommandValue>7</CommandValue></Command>
"""


def strict_xml() -> str:
    """A stricter camera: steps, gain in decibels, automatic exposure, IEEE 1588 and packed formats.

    The program behind it only stores what is written: nothing follows from these features.
    """
    xml = small_sensor_xml()
    registers = "".join(
        f'<IntReg Name="Free{number}" NameSpace="Custom"><Address>0x{0x200 + 4 * number:x}</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
        for number in range(1, 7)
    )
    formats = "".join(
        f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{code}</Value></EnumEntry>'
        for name, code in (("Mono12Packed", 0x010C0006), ("Mono12p", 0x010C0047), ("Mono12", 0x01100005))
    )
    for old, new in (
        ("<pFeature>Debug</pFeature>", "<pFeature>Debug</pFeature><pFeature>More</pFeature>"),
        ("<!-- Port -->", _MORE_FEATURES + registers),
        ('<EnumEntry Name="Mono16"', formats + '<EnumEntry Name="Mono16"'),
    ):
        assert xml.count(old) == 1, old
        xml = xml.replace(old, new)
    for name, step in (("OffsetX", 4), ("Width", 16)):
        xml, found = re.subn(rf'(<Integer Name="{name}" .*?)<Inc>1</Inc>', rf"\1<Inc>{step}</Inc>", xml, flags=re.S)
        assert found == 1
    # without a minimum of its own that lies on the steps, a width of 16 would be off by one
    xml, found = re.subn(r'(<Integer Name="Width" .*?)<Min>1</Min>', r"\1<Min>16</Min>", xml, flags=re.S)
    assert found == 1
    return xml
