"""Connections to a Newport XPS: one for questions, one a group for motions, others for stops.

The controller answers on the connection that asked, when the function has ended: a motion's answer comes at its end. So
no other question can be sent there until then, and a stop is sent over a connection on which no answer is due.
Functions have no terminator, and an answer is ``code,values,EndOfAPI``.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

from stereorig.core.errors import StageError

_END = b",EndOfAPI"
_PORT = 5001
_CONNECT_S = 1.0
_SPARES = 3  # a stop is answered when the axis rests, and more stops may come until then


class XPSRefusal(Exception):
    """Error code of a function, as the controller returned it."""

    def __init__(self, function: str, code: int) -> None:
        super().__init__(f"{function}: error {code}")
        self.code = code


class _Link:
    """One connection with one function at a time; after an error it connects again when it is used."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._guard = threading.RLock()
        self._held = b""
        self.connection: socket.socket | None = None
        self.function = ""  # the one whose answer has not come

    def connect(self) -> socket.socket:
        with self._guard:
            if self.connection is None:
                self.connection = socket.create_connection(self._address, _CONNECT_S)
                self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return self.connection

    def close(self) -> None:
        connection, self.connection = self.connection, None
        self._held, self.function = b"", ""
        if connection is not None:
            connection.close()

    def send(self, function: str) -> None:
        with self._guard:
            self.connect().sendall(function.encode("ascii"))
            self.function = function

    def answer(self, wait_s: float = 0.0) -> tuple[int, str] | None:
        """Return (code, values) if they come in time; OSError if the connection has ended."""
        deadline = time.monotonic() + wait_s
        with self._guard:
            connection = self.connect()
            while _END not in self._held:
                connection.settimeout(max(deadline - time.monotonic(), 0.0))
                try:
                    data = connection.recv(4096)
                except (TimeoutError, BlockingIOError):
                    return None
                finally:
                    connection.settimeout(_CONNECT_S)
                if not data:
                    raise ConnectionResetError("the controller ended the connection")
                self._held += data
            whole, _, self._held = self._held.partition(_END)
            self.function = ""
        code, _, values = whole.decode("ascii", errors="replace").partition(",")
        return int(code), values


class XPSLine:
    """All connections to one XPS.

    Parameters
    ----------
    url
        ``socket://host``, with ``:port`` if it is not 5001.
    groups
        Groups of the controller that are used.
    timeout_s
        Longest time of an answer to a question.
    """

    def __init__(self, url: str, groups: Sequence[str], *, timeout_s: float) -> None:
        self.url, self.is_open = url, False
        self._timeout_s = timeout_s
        address = urlsplit(url)
        self._address = (address.hostname or "", address.port or _PORT)
        self._ask = _Link(self._address)
        self._moves = {group: _Link(self._address) for group in groups}
        self._lasts = {group: _Link(self._address) for group in groups}
        self._spare = [_Link(self._address) for _ in range(_SPARES)]
        self._codes: dict[str, list[int]] = {group: [] for group in groups}
        self._asking, self._stopping = threading.RLock(), threading.Lock()

    def _all(self) -> list[_Link]:
        return [self._ask, *self._moves.values(), *self._lasts.values(), *self._spare]

    def open(self) -> None:
        """Connect; raises `StageError` ``stage_lost``."""
        try:
            self.renew()
        except StageError:
            self.close()
            raise

    def renew(self) -> None:
        """Connect again, one connection after the other, if the controller is there; errors as `open`."""
        try:
            socket.create_connection(self._address, _CONNECT_S).close()
            self.is_open = True
            for link in self._all():
                with self._stopping:  # which finds all others connected
                    link.close()
                    link.connect()
        except OSError as error:
            raise self.lost(f"cannot be reached ({error})") from error

    def close(self) -> None:
        """End all connections; safe to call twice."""
        self.is_open = False
        for link in self._all():
            link.close()

    def ask(self, function: str) -> str:
        """Return the values of a function that ends at once, asked once more if no answer comes.

        Raises
        ------
        XPSRefusal
            The controller returned an error.
        StageError
            ``stage_lost``.
        """
        failure: Exception = TimeoutError("silence")
        with self._asking:
            for _ in range(2):
                try:
                    self._check_open()
                    self._ask.send(function)
                    answer = self._ask.answer(self._timeout_s)
                except (OSError, ValueError) as error:
                    answer, failure = None, error
                if answer is None:
                    self._ask.close()  # a late answer must not be taken for the next question's
                elif answer[0] != 0:
                    raise XPSRefusal(function, answer[0])
                else:
                    return answer[1]
        raise self.lost(f"gave no answer to {function} ({failure})")

    def start(self, group: str, function: str) -> None:
        """Begin a function of a group, once; `runs` and `codes` return its end."""
        link = self._moves[group]
        try:
            self._check_open()
            if link.function:
                link.close()
            link.send(function)
        except OSError as error:
            raise self.lost(f"did not take {function} ({error})") from error

    def runs(self, group: str) -> bool:
        """Return True until the answer of the group's function has come."""
        link = self._moves[group]
        if not link.function:
            return False
        try:
            self._check_open()
            answer = link.answer()
        except (OSError, ValueError) as error:
            link.close()
            raise self.lost(f"gave no answer to a motion ({error})") from error
        if answer is not None and answer[0] != 0:
            self._codes[group].append(answer[0])
        return answer is None

    def codes(self, group: str) -> list[int]:
        """Return the errors with which functions of the group have ended since the last call."""
        self.runs(group)
        found, self._codes[group] = self._codes[group], []
        return found

    def urgent(self, text: str) -> None:
        """Write functions, separated by ``;``, each on a connection on which nothing else is waited for."""
        for function in text.split(";"):
            with self._stopping:
                failure: OSError | None = None
                for _ in range(2):
                    try:
                        self._check_open()
                        self._free().send(function)
                        break
                    except OSError as error:
                        failure = error
                else:
                    raise self.lost(f"did not take {function} ({failure})") from failure

    def last_words(self, text: str) -> list[tuple[int, bytes]]:
        """Return a copy of the descriptor of a connection a function that is used for nothing else."""
        found = []
        with self._stopping, contextlib.suppress(OSError):
            self._check_open()
            for link, function in zip(self._lasts.values(), text.split(";"), strict=True):
                found.append((os.dup(link.connect().fileno()), function.encode("ascii")))
        return found

    def _free(self) -> _Link:
        for link in self._spare:
            try:
                if not link.function or link.answer() is not None:
                    return link
            except (OSError, ValueError):
                link.close()
                return link
        self._spare.append(_Link(self._address))
        return self._spare[-1]

    def _check_open(self) -> None:
        if not self.is_open:
            raise ConnectionError("it is closed")

    def lost(self, failure: str) -> StageError:
        """Return the error of a controller that is gone or makes no sense."""
        return StageError(
            f"The XPS at {self.url} {failure}.",
            code="stage_lost",
            remedy="Check power, cable and the url in the rig file, then reconnect.",
            url=self.url,
        )
