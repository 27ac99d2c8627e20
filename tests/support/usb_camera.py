"""A USB webcam in software, plugged into the kernel's USB/IP controller: its driver is the true uvcvideo.

It speaks the USB Video Class (1.0) as a device does: descriptors, probe and commit, controls with ranges, payloads on a
bulk endpoint. Its state can be looked at from the camera's side, and its cable can be pulled.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_PORTS = Path("/sys/devices/platform/vhci_hcd.0")
_HIGH_SPEED = 3
_GONE, _STALL = -104, -32  # -ECONNRESET, -EPIPE

_SET_CUR, _GET_CUR, _GET_MIN, _GET_MAX, _GET_RES, _GET_LEN, _GET_INFO, _GET_DEF = 1, *range(0x81, 0x88)
_GUID_TAIL = bytes.fromhex("0000 1000 8000 00aa 0038 9b71")
#: format -> name in its GUID, bytes a pixel
FORMATS = (("YUYV", b"YUY2", 2), ("GREY", b"Y800", 1), ("Y16 ", b"Y16 ", 2))
SIZES = ((320, 180), (160, 120))
RATES_HZ = (30, 20, 15, 5)


@dataclass
class Dial:
    """One control of the camera, by its unit and selector."""

    size: int
    lowest: int
    highest: int
    step: int
    value: int
    info: int = 0x03  # can be read and set; 0x08: changes by itself
    clamp_at: int | None = None  # takes no more than this, without an error
    writes: list[int] = field(default_factory=list)


def _interval(rate_hz: int) -> int:
    return 10_000_000 // rate_hz


class UsbCamera:
    """A camera on one port of the virtual controller.

    Parameters
    ----------
    port
        0 to 7.
    serial
        What its label says.
    sizes
        Width and height of its pictures, the usual one first.
    """

    def __init__(self, port: int, serial: str, sizes: tuple[tuple[int, int], ...] = SIZES) -> None:
        self.port = port
        self.serial = serial
        self.sizes = sizes
        # exposure in 100 us, the mode as bits: 1 manual, 8 aperture priority (automatic exposure)
        self.mode = Dial(1, 0, 0, 0x01 | 0x08, 8)
        self.exposure = Dial(4, 10, 5000, 5, 300, info=0x0B)
        self.brightness = Dial(2, -64, 64, 1, 0)
        self.gain = Dial(2, 0, 100, 1, 20, info=0x0B, clamp_at=60)
        self.gamma, self.sharpness = Dial(2, 72, 500, 1, 120), Dial(2, 0, 6, 1, 2)
        self._dials = {(1, 2): self.mode, (1, 4): self.exposure, (2, 2): self.brightness, (2, 4): self.gain}
        self._dials |= {(2, 8): self.sharpness, (2, 9): self.gamma}
        self.frames = 0
        self.truncate = 0  # so many of the next frames lack their second half
        self.silent = False
        self._probe = self._commit = self._settled(1, 1, _interval(15))
        self._host: socket.socket | None = None
        self._nodes: list[Path] = []
        self._thread: threading.Thread | None = None
        self._waiting: deque[tuple[int, int]] = deque()
        self._payload = b""
        self._due = 0.0

    # -- the cable ---------------------------------------------------------------------------------------------------

    def plug(self) -> str:
        """Plug it in, and return the node of its pictures."""
        before = set(Path("/dev").glob("video*"))
        kernel, self._host = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._thread = threading.Thread(target=self._serve, args=(self._host,), daemon=True)
        self._thread.start()
        (_PORTS / "attach").write_text(f"{self.port} {kernel.fileno()} {0x10001 + self.port} {_HIGH_SPEED}")
        kernel.close()
        end = time.monotonic() + 20.0
        while len(found := sorted(set(Path("/dev").glob("video*")) - before)) < 2:  # pictures and metadata
            assert time.monotonic() < end, "the kernel does not see the camera"
            time.sleep(0.05)
        self._nodes = found
        return str(found[0])

    def unplug(self) -> None:
        """Pull the cable."""
        host, self._host = self._host, None
        if host is not None:
            with contextlib.suppress(OSError):
                host.shutdown(socket.SHUT_RDWR)
            assert self._thread is not None
            self._thread.join(5.0)
            host.close()
            end = time.monotonic() + 10.0
            while self._port_status() != 4 or any(node.exists() for node in self._nodes):  # VDEV_ST_NULL: free again
                assert time.monotonic() < end
                time.sleep(0.02)

    def _port_status(self) -> int:
        for line in (_PORTS / "status").read_text().splitlines()[1:]:
            words = line.split()
            if words[0] == "hs" and int(words[1]) == self.port:
                return int(words[2])
        raise AssertionError(self.port)

    # -- USB/IP ------------------------------------------------------------------------------------------------------

    def _serve(self, host: socket.socket) -> None:
        self._waiting.clear()
        try:
            while True:
                host.settimeout(self._patience())
                try:
                    head = self._read(host, 48)
                except TimeoutError:
                    self._deliver(host)
                    continue
                command, number, _, inward, endpoint = struct.unpack(">5I", head[:20])
                if command == 2:  # take a request back
                    (unlinked,) = struct.unpack(">I", head[20:24])
                    known = [entry for entry in self._waiting if entry[0] == unlinked]
                    for entry in known:
                        self._waiting.remove(entry)
                    host.sendall(struct.pack(">5Ii24x", 4, number, 0, 0, 0, _GONE if known else 0))
                    continue
                _, length = struct.unpack(">II", head[20:28])
                if endpoint:
                    self._waiting.append((number, length))
                    self._deliver(host)
                    continue
                setup = head[40:48]
                data = self._read(host, length) if length and not inward else b""
                answer = self._control(setup, data)
                if answer is None:
                    self._answer(host, number, _STALL, b"")
                else:
                    self._answer(host, number, 0, answer[:length], len(data))
        except (OSError, EOFError):
            return

    def _patience(self) -> float | None:
        if not self._waiting or self.silent:
            return 0.1 if self._waiting else None
        return max(self._due - time.monotonic(), 0.001)

    @staticmethod
    def _read(host: socket.socket, size: int) -> bytes:
        data = host.recv(size, socket.MSG_WAITALL)
        while len(data) < size:
            more = host.recv(size - len(data), socket.MSG_WAITALL)
            if not more:
                raise EOFError
            data += more
        return data

    @staticmethod
    def _answer(host: socket.socket, number: int, status: int, data: bytes, sent: int = 0) -> None:
        host.sendall(struct.pack(">5IiIIII8x", 3, number, 0, 0, 0, status, len(data) or sent, 0, 0, 0) + data)

    def _deliver(self, host: socket.socket) -> None:
        """Fill the requests that wait on the bulk endpoint, frame by frame in the camera's own time."""
        while self._waiting and not self.silent:
            if not self._payload:
                if time.monotonic() < self._due:
                    return
                period = self._commit[2] * 1e-7
                self._due = max(self._due + period, time.monotonic())
                self._payload = self._next_payload()
            number, length = self._waiting.popleft()
            part, self._payload = self._payload[:length], self._payload[length:]
            self._answer(host, number, 0, part)

    def _next_payload(self) -> bytes:
        pixels = self.picture(self.frames)
        flags = 0x80 | 0x02 | self.frames & 1  # header ends here, frame ends with this payload, toggles
        self.frames += 1
        if self.truncate > 0:
            self.truncate -= 1
            pixels = pixels[: len(pixels) // 2]
        return bytes((2, flags)) + pixels

    # -- the camera --------------------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[str, int, int]:
        """Name of the format that was committed, width and height."""
        name, _, _ = FORMATS[self._commit[0] - 1]
        return name, *self.sizes[self._commit[1] - 1]

    def gray(self, number: int) -> np.ndarray:
        """Brightness of a picture in 8 bits: a pattern that moves, brighter with the exposure."""
        _, width, height = self.shape
        rows, columns = np.indices((height, width))
        return ((3 * rows + columns + 7 * number + self.exposure.value) % 256).astype(np.uint8)

    def picture(self, number: int) -> bytes:
        """One image as it goes over the wire."""
        name, width, height = self.shape
        gray = self.gray(number)
        if name == "GREY":
            return gray.tobytes()
        wide = np.empty((height, width, 2), np.uint8)
        wide[..., 0 if name == "YUYV" else 1] = gray
        wide[..., 1 if name == "YUYV" else 0] = 0x80
        return wide.tobytes()

    def _settled(self, form: int, frame: int, interval: int) -> tuple[int, int, int]:
        form, frame = min(max(form, 1), len(FORMATS)), min(max(frame, 1), len(self.sizes))
        return form, frame, min(map(_interval, RATES_HZ), key=lambda one: abs(one - interval))

    def _streaming(self, choice: tuple[int, int, int]) -> bytes:
        form, frame, interval = choice
        width, height = self.sizes[frame - 1]
        size = width * height * FORMATS[form - 1][2]
        return struct.pack("<HBBI5HII", 1, form, frame, interval, 0, 0, 0, 0, 0, size, size + 2)

    def _control(self, setup: bytes, data: bytes) -> bytes | None:
        kind, request, value, index, _ = struct.unpack("<BBHHH", setup)
        if kind == 0x80 and request == 6:
            return self._descriptor(value >> 8, value & 255)
        if kind & 0x60 == 0:
            return {0: b"\0\0", 8: b"\1", 10: b"\0"}.get(request, b"")
        selector, unit, interface = value >> 8, index >> 8, index & 255
        if interface == 1 and selector in (1, 2):
            return self._streaming_control(request, selector, data)
        dial = self._dials.get((unit, selector)) if interface == 0 else None
        return None if dial is None else self._turn(dial, request, data)

    def _streaming_control(self, request: int, selector: int, data: bytes) -> bytes | None:
        if request == _SET_CUR:
            _, form, frame, interval = struct.unpack("<HBBI", data[:8])
            self._probe = self._settled(form, frame, interval)
            if selector == 2:
                self._commit, self._payload, self._due = self._probe, b"", time.monotonic()
            return b""
        if request == _GET_LEN:
            return struct.pack("<H", 26)
        if request == _GET_INFO:
            return b"\3"
        return self._streaming(self._probe if selector == 1 else self._commit)

    @staticmethod
    def _turn(dial: Dial, request: int, data: bytes) -> bytes | None:
        def encoded(number: int) -> bytes:
            return number.to_bytes(dial.size, "little", signed=number < 0)

        if request == _SET_CUR:
            wanted = int.from_bytes(data, "little", signed=dial.lowest < 0)
            dial.writes.append(wanted)
            if dial.highest and not dial.lowest <= wanted <= dial.highest:
                return None
            dial.value = wanted if dial.clamp_at is None else min(wanted, dial.clamp_at)
            return b""
        answers = {
            _GET_CUR: dial.value,
            _GET_MIN: dial.lowest,
            _GET_MAX: dial.highest,
            _GET_RES: dial.step,
            _GET_DEF: dial.lowest if dial.highest else 8,
        }
        if request == _GET_INFO:
            return bytes((dial.info,))
        if request == _GET_LEN:
            return struct.pack("<H", dial.size)
        return encoded(answers[request]) if request in answers else None

    # -- descriptors -------------------------------------------------------------------------------------------------

    def _descriptor(self, kind: int, number: int) -> bytes | None:
        if kind == 1:
            return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x200, 0xEF, 2, 1, 64, 0x1209, 0x0001, 0x0123, 1, 2, 3, 1)
        if kind == 2:
            return self._configuration()
        texts = ("", "Nobody", "Webcam of the tests", self.serial)
        if kind == 3 and number < len(texts):
            text = b"\x09\x04" if number == 0 else texts[number].encode("utf-16-le")
            return bytes((len(text) + 2, 3)) + text
        return None

    def _configuration(self) -> bytes:
        units = struct.pack("<BBBBHBBHHHB3s", 18, 0x24, 2, 1, 0x0201, 0, 0, 0, 0, 0, 3, b"\x0a\0\0")
        units += struct.pack("<BBBBBHB2sB", 11, 0x24, 5, 2, 1, 0, 2, b"\x31\x02", 0)
        units += struct.pack("<BBBBHBBB", 9, 0x24, 3, 3, 0x0101, 0, 2, 0)
        control = bytes((9, 4, 0, 0, 0, 0x0E, 1, 0, 2))
        control += struct.pack("<BBBHHIBB", 13, 0x24, 1, 0x0100, 13 + len(units), 6_000_000, 1, 1) + units
        formats = b""
        for index, (_, code, size) in enumerate(FORMATS, 1):
            formats += struct.pack("<BBBBB", 27, 0x24, 4, index, len(self.sizes)) + code + _GUID_TAIL
            formats += bytes((8 * size, 1, 0, 0, 0, 0))
            for at, (width, height) in enumerate(self.sizes, 1):
                count = width * height * size
                rates = [_interval(rate) for rate in RATES_HZ]
                formats += struct.pack("<BBBBBHH", 26 + 4 * len(rates), 0x24, 5, at, 0, width, height)
                formats += struct.pack("<IIII", count * 8 * 5, count * 8 * 30, count, rates[2])
                formats += bytes((len(rates),)) + struct.pack(f"<{len(rates)}I", *rates)
        head = 13 + len(FORMATS)
        stream = bytes((9, 4, 1, 0, 1, 0x0E, 2, 0, 0))
        stream += struct.pack("<BBBBHBBBBBBB", head, 0x24, 1, len(FORMATS), head + len(formats), 0x81, 0, 3, 0, 0, 0, 1)
        stream += bytes(len(FORMATS)) + formats + struct.pack("<BBBBHB", 7, 5, 0x81, 2, 512, 0)
        both = bytes((8, 11, 0, 2, 0x0E, 3, 0, 2)) + control + stream
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(both), 2, 1, 0, 0x80, 250) + both
