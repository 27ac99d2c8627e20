"""One serial line that several threads share: commands, queries with recovery, and a way for stop around every lock.

Any URL that pyserial opens will do: a port, ``socket://host:port``, ``rfc2217://host:port``. Replies may end in CR, LF
or both; stray NUL bytes and empty lines are discarded. A query without a valid reply is asked once more after the line
was flushed; a command is written once and never again.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar

import serial

from core.errors import StageError
from drivers.stages.transcript import Transcript

T = TypeVar("T")
FlowControl = Literal["hardware", "software", "none"]

# Longest time of a flush on a line that never falls silent
_FLUSH_LIMIT_S = 1.0
# A reply longer than this is noise: the longest true one is an error text below 100 characters
_LONGEST_REPLY = 512


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
        File that gets a transcript of the wire, see `drivers.stages.transcript`.

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
            try:
                port = serial.serial_for_url(
                    self.url,
                    baudrate=self._baudrate,
                    rtscts=self._flow_control == "hardware",
                    xonxoff=self._flow_control == "software",
                    timeout=self._quiet_s,
                    # the one kind of URL whose port knows no such limit; its socket has one of five seconds
                    write_timeout=None if self.url.lower().startswith("rfc2217:") else 1.0,
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
            if self._record_path is not None:
                try:
                    self._record = Transcript(self._record_path, f"{self.url} at {self._baudrate} baud").open()
                except StageError:
                    port.close()
                    raise
            self._pending.clear()
            self._dirty = True
            self._port = port

    def close(self) -> None:
        """Close the line; safe to call twice, and from any thread."""
        port, self._port = self._port, None
        if port is not None:
            connection = getattr(port, "_socket", None)
            port.close()
            # pyserial shuts the connection down first, and leaves it open where the other side was quicker
            if isinstance(connection, socket.socket):
                connection.close()
        record, self._record = self._record, None
        if record is not None:
            record.close()

    def command(self, text: str) -> None:
        """Write a command that has no reply; written once in any case."""
        with self._lock:
            if self._dirty:
                self._flush()
            self._write(text.encode("ascii") + self._terminator, ">")

    def urgent(self, text: str) -> None:
        """Write at once, around the lock that a waiting query holds.

        It is written twice: should a broken byte or half a command stand in the controller's input, the first one ends
        that, the second one is clean. Only for commands that may be repeated without harm, as stop.
        """
        self._write(2 * (text.encode("ascii") + self._terminator), "!")

    def query(self, text: str, parse: Callable[[str], T], *, timeout_s: float | None = None) -> T:
        """Ask and return ``parse(reply)``; ``parse`` raises ValueError for a text that is no answer to this question.

        Raises
        ------
        StageError
            ``stage_lost`` after the second silence or nonsense.
        """
        timeout = self._timeout_s if timeout_s is None else timeout_s
        with self._lock:
            failures: list[str] = []
            for _ in range(2):
                if self._dirty:
                    self._flush()
                self._discard_waiting()
                self._write(text.encode("ascii") + self._terminator, ">")
                try:
                    return self._answer(parse, timeout)
                except ValueError as error:
                    failures.append(str(error))
                    self._dirty = True
            raise self._lost(f"{text!r} on {self.url} brought no answer, twice ({'; '.join(failures)}).", query=text)

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
            self._write(text.encode("ascii") + self._terminator, ">")
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
        except (serial.SerialException, OSError, TypeError) as error:
            raise self._lost(f"The serial line {self.url} broke ({error}).") from error

    def _read(self) -> bytes:
        port = self._open_port()
        try:
            data = bytes(port.read(max(1, port.in_waiting)))
        except (serial.SerialException, OSError, TypeError) as error:  # TypeError: closed by another thread meanwhile
            raise self._lost(f"The serial line {self.url} broke ({error}).") from error
        if data:
            self._note("<", data)
        return data

    def _write(self, data: bytes, mark: str) -> None:
        port = self._open_port()
        try:
            port.write(data)
        except (
            serial.SerialException,
            OSError,
            TypeError,
            AssertionError,
        ) as error:  # pyserial asserts on a full socket
            raise self._lost(f"The serial line {self.url} broke ({error}).") from error
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
