"""Two small GigE Vision cameras with clocks, read-outs and trigger lines of their own, as a program.

    python -m tests.support.timed_camera '[{...}, {...}]'

The options are those of `TimedCamera`; the addresses are 127.0.0.1 and 127.0.0.2. A line of Python on standard input is
run with ``cams`` and ``pulse``; its value is printed.
"""

from __future__ import annotations

import json
import random
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator

PORT = 3956
DESCRIPTION_AT = 0x30000
ACTION_LATE, NO_CLOCK, NOT_IMPLEMENTED, DENIED = 0x8016, 0x8013, 0x8001, 0x8006
SOURCES = {"Software": 0, "Line1": 1, "Action1": 2}
PTP_STATES = {"Listening": 4, "Master": 6, "Slave": 9}
_NUMBERS = iter(range(0x20000, 0x21000, 8))
AT: dict[str, int] = {}


def _register(name: str, length: int = 4, mode: str = "RW") -> str:
    AT[name] = next(_NUMBERS)
    return (
        f'<IntReg Name="{name}_"><Address>{AT[name]:#x}</Address><Length>{length}</Length>'
        f"<AccessMode>{mode}</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    )


def _integer(name: str, low: int = 0, high: int = 2**32 - 1, length: int = 4) -> str:
    limits = f"<Min>{low}</Min><Max>{high}</Max>" if length == 4 else ""
    return f'<Integer Name="{name}"><pValue>{name}_</pValue>{limits}</Integer>' + _register(name, length)


def _float(name: str, low: float, high: float, unit: str) -> str:
    to_float = f'<Converter Name="{name}Of"><FormulaTo>FROM*1000</FormulaTo><FormulaFrom>TO/1000.0</FormulaFrom>'
    return (
        f'<Float Name="{name}"><pValue>{name}Of</pValue><Min>{low}</Min><Max>{high}</Max><Unit>{unit}</Unit></Float>'
        f"{to_float}<pValue>{name}_</pValue><Slope>Increasing</Slope></Converter>" + _register(name)
    )


def _enumeration(name: str, entries: dict[str, int]) -> str:
    body = "".join(f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items())
    return f'<Enumeration Name="{name}">{body}<pValue>{name}_</pValue></Enumeration>' + _register(name)


def _command(name: str, register: str | None = None, value: int = 1) -> str:
    target = register or name
    node = f'<Command Name="{name}"><pValue>{target}_</pValue><CommandValue>{value}</CommandValue></Command>'
    return node if register else node + _register(name)


def _boolean(name: str) -> str:
    values = "<OnValue>1</OnValue><OffValue>0</OffValue>"
    return f'<Boolean Name="{name}"><pValue>{name}_</pValue>{values}</Boolean>' + _register(name)


_FEATURES: list[tuple[str, Callable[[], str]]] = [
    ("Width", lambda: _integer("Width", 16, 64)),
    ("Height", lambda: _integer("Height", 16, 64)),
    ("PixelFormat", lambda: _enumeration("PixelFormat", {"Mono8": 0x01080001})),
    ("PayloadSize", lambda: _integer("PayloadSize")),
    ("AcquisitionMode", lambda: _enumeration("AcquisitionMode", {"Continuous": 0})),
    ("AcquisitionStart", lambda: _command("AcquisitionStart")),
    ("AcquisitionStop", lambda: _command("AcquisitionStop", "AcquisitionStart", 0)),
    ("ExposureTime", lambda: _float("ExposureTime", 20, 1000000, "us")),
    ("AcquisitionFrameRate", lambda: _float("AcquisitionFrameRate", 1, 60, "Hz")),
    ("TriggerSelector", lambda: _enumeration("TriggerSelector", {"FrameStart": 0})),
    ("TriggerMode", lambda: _enumeration("TriggerMode", {"Off": 0, "On": 1})),
    ("TriggerSource", lambda: _enumeration("TriggerSource", SOURCES)),
    ("TriggerSoftware", lambda: _command("TriggerSoftware")),
    ("LineSelector", lambda: _enumeration("LineSelector", {"Line1": 1, "Line2": 2})),
    ("LineMode", lambda: _enumeration("LineMode", {"Input": 0, "Output": 1})),
    ("LineSource", lambda: _enumeration("LineSource", {"Off": 0, "ExposureActive": 1})),
    ("ActionDeviceKey", lambda: _integer("ActionDeviceKey")),
    ("ActionSelector", lambda: _integer("ActionSelector", 0, 1)),
    ("ActionGroupKey", lambda: _integer("ActionGroupKey")),
    ("ActionGroupMask", lambda: _integer("ActionGroupMask")),
    ("GevSCPSPacketSize", lambda: _integer("GevSCPSPacketSize", 576, 1500)),
    ("PtpEnable", lambda: _boolean("PtpEnable")),
    ("PtpStatus", lambda: _enumeration("PtpStatus", PTP_STATES)),
    ("PtpParentClockID", lambda: _integer("PtpParentClockID", length=8)),
    ("GevPersistentIPAddress", lambda: _integer("GevPersistentIPAddress")),
    ("GevPersistentSubnetMask", lambda: _integer("GevPersistentSubnetMask")),
    ("GevPersistentDefaultGateway", lambda: _integer("GevPersistentDefaultGateway")),
    ("GevCurrentIPConfigurationPersistentIP", lambda: _boolean("GevCurrentIPConfigurationPersistentIP")),
    ("TimestampLatch", lambda: _command("TimestampLatch")),
    ("TimestampLatchValue", lambda: _integer("TimestampLatchValue", length=8)),
]


_MADE = {name: make() for name, make in _FEATURES}


def _xml(*, latch: bool) -> bytes:
    made = dict(_MADE)
    # the packet size lies at the standard's own place
    made["GevSCPSPacketSize"] = (
        '<Integer Name="GevSCPSPacketSize"><pValue>PacketSize_</pValue><Min>576</Min><Max>1500</Max><Inc>4</Inc>'
        '</Integer><MaskedIntReg Name="PacketSize_"><Address>0xD04</Address><Length>4</Length><AccessMode>RW'
        "</AccessMode><pPort>Device</pPort><LSB>31</LSB><MSB>16</MSB><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></MaskedIntReg>"
    )
    names = [name for name in made if latch or not name.startswith("TimestampLatch")]
    listed = "".join(f"<pFeature>{name}</pFeature>" for name in names)
    head = '<RegisterDescription ModelName="Timed" VendorName="Tests" StandardNameSpace="GEV" SchemaMajorVersion="1" '
    head += 'SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
    head += 'ProductGuid="0" VersionGuid="0" xmlns="http://www.genicam.org/GenApi/Version_1_1">'
    body = f'<Category Name="Root">{listed}</Category>' + "".join(made[name] for name in names)
    return f'{head}{body}<Port Name="Device" NameSpace="Standard"/></RegisterDescription>'.encode()


class TimedCamera:
    """One camera.

    Parameters
    ----------
    offset_ns, ppm
        The camera's clock is ``host * (1 + ppm * 1e-6) + offset_ns``.
    readout_s
        From the end of an exposure to the frame's first packet.
    latch
        False for a description without a latch.
    deaf, lost
        Share of action commands that do not reach the camera, and of its frames that do not leave it.
    """

    def __init__(
        self,
        ip: str,
        serial: str,
        *,
        offset_ns: int = 0,
        ppm: float = 0.0,
        readout_s: float = 0.002,
        latch: bool = True,
        deaf: float = 0.0,
        lost: float = 0.0,
    ) -> None:
        self.ip, self.offset_ns, self.ppm, self.readout_s = ip, offset_ns, ppm, readout_s
        self.deaf, self.lost = deaf, lost
        self.slave: TimedCamera | None = None  # the camera at the end of this one's strobe line
        self.exposed: list[int] = []  # true begins, by the host's clock
        self.delivered: list[int] = []  # numbers of the action commands whose frames left the camera
        self.number = 0
        self._random = random.Random(serial)
        self._latches = latch
        self._controller: object = None
        self._mem = bytearray(0x40000)
        self._lock = threading.RLock()
        self._socket = self._stream = _bound(ip, PORT)
        xml = _xml(latch=latch)
        self._mem[DESCRIPTION_AT : DESCRIPTION_AT + len(xml)] = xml
        for at, value in {
            0x0: 0x10002,
            0x4: 0x80000001,
            0x8: 0x203,
            0xC: hash(ip) & 0xFFFFFFF,
            0x600: 1,
            0x904: 1,
        }.items():
            self.put(at, value)
        self._mem[0x24:0x28] = socket.inet_aton(ip)
        for at, text in (
            (0x48, "Tests"),
            (0x68, "Timed"),
            (0xD8, serial),
            (0x200, f"Local:c.xml;{DESCRIPTION_AT:X};{len(xml):X}"),
        ):
            self._mem[at : at + len(text)] = text.encode()
        for at, value in {0x934: 6, 0x938: 3000, 0x940: 10**9, 0xD04: 1500}.items():
            self.put(at, value)
        for name, value in {"Width": 64, "Height": 64, "PixelFormat": 0x01080001, "PayloadSize": 4096}.items():
            self.put(AT[name], value)
        self.put(AT["ExposureTime"], 1_000_000)
        self.put(AT["AcquisitionFrameRate"], 10_000)

    def start(self) -> None:
        """Answer on the camera's own address and on broadcasts."""
        self._stream = _bound(self.ip, 0)
        for line in (self._socket, _bound("127.255.255.255", PORT), _bound("255.255.255.255", PORT)):
            threading.Thread(target=self._serve, args=(line,), daemon=True).start()
        threading.Thread(target=self._run, daemon=True).start()

    def put(self, at: int, value: int, length: int = 4) -> None:
        self._mem[at : at + length] = value.to_bytes(length, "big")

    def get(self, name: str, length: int = 4) -> int:
        return int.from_bytes(self._mem[AT[name] : AT[name] + length], "big")

    def set(self, name: str, value: int, length: int = 4) -> None:
        self.put(AT[name], value, length)

    def ptp(self, state: str, parent: int) -> None:
        """Follow a master, or listen for one."""
        self.set("PtpStatus", PTP_STATES[state])
        self.set("PtpParentClockID", parent, 8)

    def clock_ns(self, host_ns: int) -> int:
        return host_ns + round(host_ns * self.ppm * 1e-6) + self.offset_ns

    def _serve(self, line: socket.socket) -> None:
        while True:
            data, marks, _, peer = line.recvmsg(2048, 64)
            # a busy machine's program comes late to a packet that a camera takes at once
            seconds, part = struct.unpack("qq", marks[0][2][:16])
            came_ns = seconds * 10**9 + part + time.monotonic_ns() - time.time_ns()
            key, flags, command, size, number = struct.unpack(">BBHHH", data[:8])
            if key == 0x42:
                status, answer = self._answer(command, flags, number, data[8 : 8 + size], peer, came_ns)
                if command == 0x0002 or (flags & 1 and status is not None):
                    self._socket.sendto(
                        struct.pack(">HHHH", status or 0, command + 1, len(answer), number) + answer, peer
                    )

    def _answer(
        self, command: int, flags: int, number: int, body: bytes, peer: object, came_ns: int
    ) -> tuple[int | None, bytes]:
        with self._lock:
            if command == 0x0002:
                return 0, bytes(self._mem[:0xF8])
            if command == 0x0080:
                places = struct.unpack(f">{len(body) // 4}I", body)
                return 0, b"".join(bytes(self._mem[at : at + 4]) for at in places)
            if command == 0x0084:
                at, _, count = struct.unpack(">IHH", body)
                return 0, body[:4] + bytes(self._mem[at : at + count])
            if command in (0x0082, 0x0086):
                (at,) = struct.unpack(">I", body[:4])
                return self._write(at, body[4:], peer), struct.pack(">HH", 0, 1 if command == 0x0082 else len(body) - 4)
            if command == 0x0100:
                return self._action(flags, number, body, came_ns), b""
        return NOT_IMPLEMENTED, b""

    def _write(self, at: int, raw: bytes, peer: object) -> int:
        value = int.from_bytes(raw[:4], "big")
        if at == 0xA00:
            if self._controller not in (None, peer):
                return DENIED
            self._controller = peer if value & 3 else None
        elif self._controller != peer:
            return DENIED
        if at == 0x0D04:
            self.put(at, value & 0x7FFFFFFF)
            return 0
        self._mem[at : at + len(raw)] = raw
        if at == AT["TimestampLatch"] and self._latches:
            self.set("TimestampLatchValue", self.clock_ns(time.monotonic_ns()), 8)
        if at == AT["TriggerSoftware"] and self.waits_for("Software"):
            self.expose_at(time.monotonic_ns())
        return 0

    def _action(self, flags: int, number: int, body: bytes, now: int) -> int | None:
        device, group, mask = struct.unpack(">III", body[:12])
        wanted = device == self.get("ActionDeviceKey") and group == self.get("ActionGroupKey")
        if not wanted or not mask & self.get("ActionGroupMask") or self._random.random() < self.deaf:
            return None
        status, due = 0, now
        if flags & 0x80:
            (when,) = struct.unpack(">Q", body[12:20])
            due = now + when - self.clock_ns(now)
            if self.get("PtpStatus") not in (PTP_STATES["Slave"], PTP_STATES["Master"]):
                status = NO_CLOCK
            elif due < now:
                status = ACTION_LATE
        if status in (0, ACTION_LATE) and self.waits_for("Action1"):
            self.expose_at(max(due, now), number)
        return status

    def waits_for(self, source: str) -> bool:
        on = self.get("AcquisitionStart") == 1 and self.get("TriggerMode") == 1
        return on and self.get("TriggerSource") == SOURCES[source]

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            if self.get("AcquisitionStart") == 1 and self.get("TriggerMode") == 0:
                self.expose_at(time.monotonic_ns())
                due = max(due + 1000.0 / self.get("AcquisitionFrameRate"), time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
            else:
                due = time.monotonic()
                time.sleep(0.002)

    def expose_at(self, begin_ns: int, command: int = 0) -> None:
        """Expose at a time of the host, in a thread of its own; drive the strobe line."""
        with self._lock:
            self.number = self.number % 65535 + 1
            number = self.number
            self.exposed.append(begin_ns)
        threading.Thread(target=self._expose, args=(number, begin_ns, command), daemon=True).start()
        strobe = self.get("LineMode") == 1 and self.get("LineSource") == 1
        if strobe and self.slave is not None and self.slave.waits_for("Line1"):
            self.slave.expose_at(begin_ns + 20_000)

    def _expose(self, number: int, begin_ns: int, command: int) -> None:
        end_s = begin_ns / 1e9 + self.get("ExposureTime") / 1e9 + self.readout_s
        time.sleep(max(0.0, end_s - time.monotonic()))
        to = socket.inet_ntoa(bytes(self._mem[0xD18:0xD1C])), int.from_bytes(self._mem[0xD02:0xD04], "big")
        if to[1] and self.get("AcquisitionStart") == 1 and self._random.random() >= self.lost:
            self.delivered.append(command)
            for packet in self._packets(number, self.clock_ns(begin_ns)):
                self._stream.sendto(packet, to)

    def _packets(self, number: int, stamp: int) -> Iterator[bytes]:
        pixels = bytes((number + k) % 251 for k in range(4096))
        image = struct.pack(">HHQIIIIIHH", 0, 1, stamp, 0x01080001, 64, 64, 0, 0, 0, 0)
        yield struct.pack(">HHI", 0, number, 1 << 24) + image
        step = int.from_bytes(self._mem[0xD06:0xD08], "big") - 36
        blocks = [pixels[k : k + step] for k in range(0, len(pixels), step)]
        for k, block in enumerate(blocks, 1):
            yield struct.pack(">HHI", 0, number, 3 << 24 | k) + block
        yield struct.pack(">HHIHHI", 0, number, 2 << 24 | len(blocks) + 1, 0, 1, 64)


def _bound(ip: str, port: int) -> socket.socket:
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    line.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
    line.bind((ip, port))
    return line


def main(options: str) -> None:
    """Run until standard input ends."""
    cams = [TimedCamera(f"127.0.0.{k + 1}", f"TIMED{k + 1}", **one) for k, one in enumerate(json.loads(options))]
    for cam in cams:
        cam.start()
    cams[0].slave = cams[-1]

    def pulse(skew_ms: float = 0.0, n: int = 1, hz: float = 10.0) -> None:
        """Raise both cameras' lines, the second's so much later."""
        for _ in range(n):
            now = time.monotonic_ns()
            for cam, at in zip(cams, (now, now + round(skew_ms * 1e6)), strict=True):
                if cam.waits_for("Line1"):
                    cam.expose_at(at)
            time.sleep(1.0 / hz)

    def steady(hz: float) -> None:
        """Go on with pulses at a rate; the skew is that of the last call of `skewed`."""
        while True:
            pulse(skew[0], 1, hz)

    def skewed(skew_ms: float) -> None:
        skew[0] = skew_ms

    skew = [0.0]
    known = {"cams": cams, "pulse": pulse, "skewed": skewed, "threading": threading}
    known["steady"] = lambda hz: threading.Thread(target=steady, args=(hz,), daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        try:
            answer = eval(line, known)
        except Exception as error:  # noqa: BLE001
            answer = f"failed: {error!r}"
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
