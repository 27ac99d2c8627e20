"""One serial line that several threads share: commands, queries with recovery, and a way for stop around every lock.

Any URL that pyserial opens will do: a port, ``socket://host:port``, ``rfc2217://host:port``. Replies may end in CR, LF
or both; stray NUL bytes and empty lines are discarded. A query without a valid reply is asked once more after the line
was flushed; a command is written once and never again.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar

import serial

from stereorig.core.errors import StageError
from stereorig.drivers.stages.transcript import Transcript

T = TypeVar("T")
FlowControl = Literal["hardware", "software", "none"]

# Longest time of a flush on a line that never falls silent
_FLUSH_LIMIT_S = 1.0
# A reply longer than this is noise: the longest true one is an error text below 100 characters
_LONGEST_REPLY = 512
# Errors that pyserial raises for a port that broke, or that another thread closed in between: a number or a socket that
# is None
_BROKEN = (serial.SerialException, OSError, TypeError, AttributeError)


class SerialLine:
    """A shared line to one controller, or to a chain of them.

    Parameters
    ----------
    url
        URL for `serial.serial_for_url`.
    terminator
        Ends every command.
    baudrate
        For true serial ports, also those behind ``rfc2217://``; sockets and ptys ignore it.
    flow_control
        ``hardware`` (RTS and CTS), ``software`` (XON and XOFF) or ``none``; likewise.
    timeout_s
        Longest wait of a query for a valid reply.
    quiet_s
        The line counts as flushed when nothing came for this long.
    resync
        For controllers whose replies do not name their question: a harmless query and a test for its reply. It is asked
        after a flush, and all that comes before its reply is a late answer to something older.
    record
        File that gets a transcript of the wire, see `stereorig.drivers.stages.transcript`.

    Attributes
    ----------
    losses
        Number of losses of the controller; drivers compare it to discard values from before a loss.
    """

    def __init__(
        self,
        url: str,
        *,
        terminator: bytes,
        baudrate: int,
        flow_control: FlowControl = "none",
        timeout_s: float = 0.5,
        quiet_s: float = 0.03,
        resync: tuple[str, Callable[[str], bool]] | None = None,
        record: Path | None = None,
    ) -> None:
        self.url = url
        self._terminator = terminator
        self._baudrate = baudrate
        self._flow_control = flow_control
        self._timeout_s = timeout_s
        self._quiet_s = quiet_s
        self._resync = resync
        self._record_path = record
        self._record: Transcript | None = None
        self._port: serial.Serial | None = None
        self._lock = threading.RLock()
        self._ports = threading.Lock()  # while a port is closed or replaced
        self._broken = False
        self._pending = bytearray()
        self._dirty = False
        self.losses = 0

    @property
    def is_open(self) -> bool:
        """True if the line is open; independent of the device at the other end."""
        return self._port is not None

    def open(self) -> None:
        """Open the line; code ``device_busy`` when another program holds it, ``stage_lost`` when it is not there."""
        with self._lock:
            if self._port is not None:
                return
            port = self._opened_port()
            if self._record_path is not None:
                try:
                    self._record = Transcript(self._record_path, f"{self.url} at {self._baudrate} baud").open()
                except StageError:
                    port.close()
                    raise
            self._take(port)

    def renew(self) -> None:
        """Open the line again if it is closed, broken or a network's; errors as `open`.

        Silence of a network connection does not show if the other side is gone. The old connection is used until there
        is a new one, so that a stop can be written at any time.
        """
        with self._lock:
            if self._port is None or (self._broken and "://" not in self.url):
                self.close()
                self.open()
            elif "://" in self.url:
                try:
                    port = self._opened_port()
                except StageError:
                    if self._broken:
                        self.close()
                        raise
                    return  # some take one connection at a time
                with self._ports:
                    old = self._port
                    self._take(port)
                _close(old)

    def _take(self, port: serial.Serial) -> None:
        self._pending.clear()
        self._dirty, self._broken = True, False
        self._port = port

    @property
    def _write_timeout_s(self) -> float | None:
        """Limit of a write; a busy host may hold a write to a socket for longer than a serial port's output waits."""
        if "://" not in self.url:
            return 1.0
        # the one kind of URL whose port knows no such limit; its socket has the same
        return None if self.url.lower().startswith("rfc2217:") else 5.0

    def _opened_port(self) -> serial.Serial:
        try:
            port = serial.serial_for_url(
                self.url,
                baudrate=self._baudrate,
                rtscts=self._flow_control == "hardware",
                xonxoff=self._flow_control == "software",
                timeout=self._quiet_s,
                write_timeout=self._write_timeout_s,
                exclusive=True,
            )
        except (serial.SerialException, OSError, ValueError, NotImplementedError) as error:
            text = str(error)
            if "exclusively lock" in text or "busy" in text.lower():
                raise StageError(
                    f"The serial line {self.url} is held by another program ({text}).",
                    code="device_busy",
                    remedy="Close the other program, then reconnect.",
                    url=self.url,
                ) from error
            raise self._lost(f"The serial line {self.url} cannot be opened ({text}).") from error
        # A stop must not wait for the acknowledgement of an earlier segment (Nagle, up to 40 ms)
        connection = getattr(port, "_socket", None)
        if isinstance(connection, socket.socket):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return port

    def close(self) -> None:
        """Close the line; safe to call twice, and from any thread."""
        with self._ports:
            port, self._port = self._port, None
            _close(port)
        record, self._record = self._record, None
        if record is not None:
            record.close()

    def _bytes(self, text: str) -> bytes:
        """Return a command as it is written."""
        return text.encode("ascii") + self._terminator

    def command(self, text: str) -> None:
        """Write a command that has no reply; written once in any case."""
        with self._lock:
            if self._dirty:
                self._flush()
            self._write(self._bytes(text), ">")

    def urgent(self, text: str) -> None:
        """Write at once, around the lock that a waiting query holds.

        It is written twice: if a broken byte or half a command is in the controller's input, the first one ends that,
        the second one is clean. Only for commands that may be repeated without harm, as stop.
        """
        port = self._port
        try:
            self._write(self.urgent_bytes(text), "!")
        except StageError:
            if self._port in (None, port):
                raise
            self._write(self.urgent_bytes(text), "!")  # to the connection that has just replaced the old one

    def urgent_bytes(self, text: str) -> bytes:
        """Return the bytes that `urgent` writes."""
        return 2 * self._bytes(text)

    def last_words(self, text: str) -> list[tuple[int, bytes]]:
        """Return a copy of the open line's file descriptor, to be closed, and the bytes that `urgent` writes.

        Empty if this kind of URL has no descriptor.
        """
        with self._ports:  # else another file may have got its number
            port = self._open_port()
            connection = getattr(port, "_socket", None)
            try:
                copy = os.dup((connection if isinstance(connection, socket.socket) else port).fileno())
            except OSError:  # io.UnsupportedOperation is one
                return []
        return [(copy, self.urgent_bytes(text))]

    def query(self, text: str, parse: Callable[[str], T], *, timeout_s: float | None = None, once: bool = False) -> T:
        """Ask and return ``parse(reply)``; ``parse`` raises ValueError for a text that is no answer to this question.

        ``once`` is for a command whose reply is awaited: it is never written again.

        Raises
        ------
        StageError
            ``stage_lost`` after the second silence or nonsense, with ``once`` after the first.
        """
        timeout = self._timeout_s if timeout_s is None else timeout_s
        with self._lock:
            failures: list[str] = []
            for _ in range(1 if once else 2):
                if self._dirty:
                    self._flush()
                self._discard_waiting()
                self._write(self._bytes(text), ">")
                try:
                    return self._answer(parse, timeout)
                except ValueError as error:
                    failures.append(str(error))
                    self._dirty = True
            raise self._lost(f"{text!r} on {self.url} brought no answer ({'; '.join(failures)}).", query=text)

    def _answer(self, parse: Callable[[str], T], timeout_s: float) -> T:
        deadline = time.monotonic() + timeout_s
        reason = "silence"
        while (line := self._read_line(deadline)) is not None:
            try:
                return parse(line)
            except ValueError as error:
                # the true answer may still follow a stray line
                reason = f"got {line[:60]!r}: {error}"
        if self._pending:
            reason = f"half a reply {bytes(self._pending[:60])!r}"
        raise ValueError(reason)

    def _read_line(self, deadline: float) -> str | None:
        while True:
            end = next((i for i, byte in enumerate(self._pending) if byte in b"\r\n"), None)
            if end is not None:
                line = bytes(self._pending[:end]).replace(b"\0", b"").strip()
                del self._pending[: end + 1]
                if line:
                    return line.decode("ascii", errors="replace")
                continue
            if len(self._pending) > _LONGEST_REPLY:
                self._pending.clear()
            if time.monotonic() >= deadline:
                return None
            self._pending += self._read()

    def _flush(self) -> None:
        """Discard input until the line is quiet, then make sure that the next reply belongs to its question."""
        limit = time.monotonic() + _FLUSH_LIMIT_S
        while self._read() and time.monotonic() < limit:
            pass
        self._pending.clear()
        if self._resync is not None:
            text, is_reply = self._resync
            self._write(self._bytes(text), ">")
            deadline = time.monotonic() + self._timeout_s
            while (line := self._read_line(deadline)) is not None:
                if is_reply(line):
                    break
            else:
                raise self._lost(f"The controller on {self.url} is silent ({text!r} after a flush).", query=text)
        self._pending.clear()
        self._dirty = False

    def _discard_waiting(self) -> None:
        self._pending.clear()
        limit = time.monotonic() + _FLUSH_LIMIT_S
        port = self._open_port()
        try:
            while port.in_waiting and time.monotonic() < limit:
                self._read()
        except _BROKEN as error:
            raise self._break(port, error) from error

    def _read(self) -> bytes:
        port = self._open_port()
        try:
            data = bytes(port.read(max(1, port.in_waiting)))
        except _BROKEN as error:
            raise self._break(port, error) from error
        if data:
            self._note("<", data)
        return data

    def _write(self, data: bytes, mark: str) -> None:
        port = self._open_port()
        try:
            port.write(data)
        except (*_BROKEN, AssertionError) as error:  # pyserial asserts on a full socket
            raise self._break(port, error) from error
        self._note(mark, data)

    def _open_port(self) -> serial.Serial:
        port = self._port
        if port is None:
            raise self._lost(f"The serial line {self.url} is closed.")
        return port

    def _note(self, mark: str, data: bytes) -> None:
        record = self._record
        if record is not None:
            record.note(mark, data)

    def _break(self, port: serial.Serial, error: Exception) -> StageError:
        self._broken = self._broken or self._port is port
        return self._lost(f"The serial line {self.url} broke ({error}).")

    def _lost(self, cause: str, **context: str) -> StageError:
        self._dirty = True
        self.losses += 1
        if self._record is not None:
            self._record.remark(cause)
        return StageError(
            cause,
            code="stage_lost",
            remedy="Check power, cable and the url in the rig file, reconnect, and home the stage before it is used.",
            url=self.url,
            **context,
        )


def _close(port: serial.Serial | None) -> None:
    if port is None:
        return
    connection = getattr(port, "_socket", None)
    if connection is None:
        # the lock belongs to every copy of the descriptor, and another process may hold one
        with contextlib.suppress(serial.SerialException, OSError, ValueError):
            port.exclusive = False
    port.close()
    # pyserial shuts the connection down first, and leaves it open where the other side was quicker
    if isinstance(connection, socket.socket):
        connection.close()
