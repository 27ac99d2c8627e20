"""Sources of a channel's lines: a socket, a serial port, a program, an analog input read in volts."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import PurePath
from typing import Protocol

import serial

from stereorig.core.errors import InputError

_log = logging.getLogger("stereorig.channels")

_WAIT_S = 0.1  # longest wait for bytes, so that an end is noticed
OPEN_S = 3.0
_CHUNK = 4096
_FRAME = re.compile(r"([5-8])([NEOMS])(1|1\.5|2)")
_END_S = 2.0  # after SIGTERM
_LAST_WORDS = 300
#: the system ends the program when the thread that reads it is gone, even if the service was killed
_ENDS_WITH_READER = (
    "import ctypes, os, signal, sys; ctypes.CDLL(None).prctl(1, signal.SIGKILL); "
    "os.getppid() == int(sys.argv[1]) or os._exit(1); os.execvp(sys.argv[2], sys.argv[2:])"
)


class Port(Protocol):
    """An open line."""

    #: seconds that a byte takes over the line; 0 if that is not known
    byte_s: float = 0.0

    def read(self) -> bytes:
        """Return the bytes that came; empty after a short wait."""

    def write(self, data: bytes) -> None:
        """Send."""

    def close(self) -> None:
        """Close it."""


class Socket(Port):
    """A TCP connection."""

    def __init__(self, host: str, port: int) -> None:
        self._link = socket.create_connection((host, port), timeout=OPEN_S)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._link.settimeout(_WAIT_S)

    def read(self) -> bytes:
        """See `Port`."""
        try:
            data = self._link.recv(_CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise OSError("the other side closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """See `Port`."""
        self._link.sendall(data)

    def close(self) -> None:
        """See `Port`."""
        self._link.close()


class Serial(Port):
    """A serial port, also over a network.

    Raises
    ------
    InputError
        For a ``frame`` that is none.
    """

    def __init__(self, url: str, baudrate: int, frame: str) -> None:
        found = _FRAME.fullmatch(frame)
        if found is None:
            raise InputError(f"{frame!r} is no frame of a serial port, as 8N1 or 7E1 is.", code="option_out_of_range")
        stop_bits = float(found[3])
        self._port = serial.serial_for_url(
            url,
            baudrate=baudrate,
            bytesize=int(found[1]),
            parity=found[2],
            stopbits=stop_bits,
            timeout=_WAIT_S,
            write_timeout=OPEN_S,
        )
        self.byte_s = (1.0 + int(found[1]) + (found[2] != "N") + stop_bits) / baudrate

    def read(self) -> bytes:
        """See `Port`."""
        first: bytes = self._port.read(1)
        return first + self._port.read(min(self._port.in_waiting, _CHUNK)) if first else first

    def write(self, data: bytes) -> None:
        """See `Port`."""
        self._port.write(data)

    def close(self) -> None:
        """See `Port`."""
        self._port.close()


class Program(Port):
    """A program that writes lines; it is ended with this port, and by the system with the thread that opened it."""

    def __init__(self, command: Sequence[str]) -> None:
        self._name, self._words = PurePath(command[0]).name, b""
        if shutil.which(command[0]) is None:
            raise OSError(f"{self._name} is not there, or is no program")
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _ENDS_WITH_READER, str(os.getpid()), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )

    def read(self) -> bytes:
        """See `Port`."""
        out, err = self._process.stdout, self._process.stderr
        assert out is not None
        assert err is not None
        ready, _, _ = select.select([out, err], [], [], _WAIT_S)
        words = os.read(err.fileno(), _CHUNK) if err in ready else b""
        self._words = (self._words + words)[-_LAST_WORDS:]
        if out not in ready:
            if err in ready and not words:  # closed, and else always ready
                time.sleep(_WAIT_S)
            return b""
        data = os.read(out.fileno(), _CHUNK)
        if not data:
            status = self._process.wait(_END_S)
            _log.warning("%s ended with status %d: %s", self._name, status, self._words.decode("utf-8", "replace"))
            raise OSError(f"{self._name} ended with status {status}; the log has its last words")
        return data

    def write(self, data: bytes) -> None:
        """See `Port`."""
        assert self._process.stdin is not None, "a pipe"
        self._process.stdin.write(data)

    def close(self) -> None:
        """End the program and its children."""
        process = self._process
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_END_S)
                break
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


class Analog(Port):
    """An analog input by National Instruments' driver, a line of volts each time it is due.

    Raises
    ------
    InputError
        ``driver_missing`` without the package nidaqmx.
    """

    def __init__(self, channel: str, rate_hz: float) -> None:
        try:
            import nidaqmx
        except ImportError as error:
            raise InputError(
                "The package nidaqmx is not installed.",
                code="driver_missing",
                remedy="pip install 'stereorig[nidaqmx]', and NI-DAQmx itself from National Instruments.",
            ) from error
        self._task = nidaqmx.Task()
        self._period_s, self._due_s = 1.0 / rate_hz, time.monotonic()
        try:
            self._task.ai_channels.add_ai_voltage_chan(channel)
            self._task.start()  # else each reading starts and ends it
        except Exception:
            self._task.close()
            raise

    def read(self) -> bytes:
        """See `Port`."""
        wait_s = self._due_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(min(wait_s, _WAIT_S))
            if wait_s > _WAIT_S:
                return b""
        self._due_s = max(self._due_s + self._period_s, time.monotonic())
        return f"{self._task.read():.9g}\n".encode()

    def write(self, data: bytes) -> None:
        """See `Port`; there is nothing to ask."""

    def close(self) -> None:
        """See `Port`."""
        self._task.close()
