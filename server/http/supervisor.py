"""The service's first process: starts the rig process and the web process, and stops the stage when either dies.

It holds the stage's lines open as well, so that it can write the stop when the rig process is dead or does not answer.
The control sockets to both carry JSON, one object a message; the rig process sends the lines' descriptors along.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import functools
import itertools
import json
import logging
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from stereorig.server.front.front import ConnectionLimits, Front, HaltFailed, HaltMade
from stereorig.server.front.messages import Halt
from stereorig.server.http.rights import HaltRights
from stereorig.server.http.systemd import Notifier

_log = logging.getLogger("stereorig.serving")

_MESSAGE_BYTES = 65536
_MAX_LINES = 31  # a stage has no more axes
_TICK_S = 0.1
# after that the stop is written here too, as it may be on the wire twice; an abort waits for the motors
_RIG_ANSWERS_S: dict[Halt, float] = {"stop": 0.04, "abort": 1.0}
_WRITE_S = 0.04
_HALT_PATIENCE_S = 8.0  # an abort waits until the motors are off
_GRACE_S = 3.0
_WEB_ENDS_S = 30.0
_RIG_ENDS_S = 10.0
# a process that ends so soon after its start is started again after a pause
_SOON_S, _PAUSE_S = 5.0, 1.0
# a web process that cannot start so often in a row will not do better the next time
_OFTEN = 4
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


@dataclass(frozen=True)
class ServePlan:
    """Arguments of a service, as its processes need them.

    Parameters
    ----------
    data
        The data folder.
    web
        Arguments of the web process (`stereorig.server.cli.web.WebArguments`), without those that are made
        here.
    log_level, log_format
        As `stereorig.server.base.logs.configure`.
    scheme
        ``http`` or ``https``.
    rig_module
        Module that is the rig process.
    """

    data: Path
    web: dict[str, Any]
    log_level: str
    log_format: str
    scheme: str
    rig_module: str = "stereorig.server.rig.process.host"


class Ready(TypedDict):
    """What the web process says when it serves: hosts that it answers for, if keys are required, names to announce."""

    hosts: list[str]
    required: bool
    max_open: int
    name: str
    data: str


class Message(TypedDict, total=False):
    """A request to a process of the service (``do``, ``id``), its answer (``of``), or news of the process' own."""

    do: str
    id: int
    ending: bool
    refused: dict[str, int]
    of: int
    alive: bool
    number: int
    elapsed_ms: float
    code: str
    cause: str
    remedy: str
    lines: list[str]
    ready: Ready


class _Child:
    """A process of the service, with a control socket to it."""

    def __init__(self, module: str, *arguments: str, descriptors: tuple[int, ...] = ()) -> None:
        self.control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(theirs.fileno()), *map(str, descriptors), *arguments],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), *descriptors),
                process_group=0,  # a terminal's Ctrl-C is the first process' to handle
            )
        self.control.setblocking(False)
        self.ended = os.pidfd_open(self.process.pid)
        self.since = time.monotonic()

    def say(self, message: Message) -> bool:
        """Send a message; return False if the process does not take it."""
        try:
            self.control.send(json.dumps(message).encode())
        except OSError:
            return False
        return True

    def heard(self) -> tuple[Message, list[int]] | None:
        """Return the next message with its descriptors; None if there is none.

        Raises
        ------
        EOFError
            None will come.
        """
        try:
            data, descriptors, _, _ = socket.recv_fds(self.control, _MESSAGE_BYTES, _MAX_LINES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise EOFError from error
        if not data:
            raise EOFError
        return json.loads(data), descriptors

    def release(self) -> int:
        """Take note of its end, and return its status."""
        status = self.process.wait()
        self.control.close()
        os.close(self.ended)
        return status


class Supervisor:
    """Front, rig process and web process of a service.

    Parameters
    ----------
    plan
        Arguments.
    listener
        Bound, for clients.
    tls
        Certificate and key, to serve https.
    notifier
        Reports to systemd.
    announce
        Called with the rig's name and the data folder when clients are served.
    """

    def __init__(
        self,
        plan: ServePlan,
        listener: socket.socket,
        *,
        tls: ssl.SSLContext | None = None,
        notifier: Notifier | None = None,
        announce: Callable[[str, str], None] = lambda _name, _data: None,
    ) -> None:
        self._plan, self._listener, self._tls = plan, listener, tls
        self._notifier = notifier or Notifier({})
        self._announce = announce
        self._folder = Path(tempfile.mkdtemp(prefix="stereorig-"))  # for this user alone
        self._rig: _Child | None = None
        self._web: _Child | None = None
        self._front: Front | None = None
        self._lines: list[tuple[int, bytes]] = []
        self._numbers = itertools.count(1)
        self._asked: dict[int, asyncio.Future[Message]] = {}
        self._refused: collections.Counter[str] = collections.Counter()
        self._web_ready = False
        self._failed_starts = 0
        self._probe: asyncio.Task[None] | None = None
        self._status: asyncio.Future[int]
        self._ending = False

    async def run(self) -> int:
        """Serve until a signal asks for the end; return the exit status."""
        loop = asyncio.get_running_loop()
        self._status = loop.create_future()
        calls = socket.socket(socket.AF_UNIX)
        calls.bind(str(self._folder / "rig"))
        calls.listen(64)
        self._calls = calls
        for number in _ENDS:
            loop.add_signal_handler(number, self._begin_end)
        try:
            self._start_rig()
            self._start_web()
            ticking = asyncio.create_task(self._tick())
            status = await self._status
            ticking.cancel()
            await self._end()
            return status
        finally:
            for child in (self._web, self._rig):
                if child is not None:
                    child.process.kill()
            calls.close()
            self._listener.close()
            shutil.rmtree(self._folder, ignore_errors=True)

    # processes --------------------------------------------------------------------------------------------------------

    def _start_rig(self) -> None:
        rig = self._rig = _Child(
            self._plan.rig_module,
            str(self._folder),
            self._plan.log_level,
            self._plan.log_format,
            descriptors=(self._calls.fileno(),),
        )
        loop = asyncio.get_running_loop()
        loop.add_reader(rig.control, self._hear, rig)
        loop.add_reader(rig.ended, self._rig_ended, rig)

    def _start_web(self) -> None:
        arguments = {**self._plan.web, "folder": str(self._folder), "first": self._front is None}
        self._web_ready = False
        web = self._web = _Child("stereorig.server.cli.web", str(os.getpid()), json.dumps(arguments))
        loop = asyncio.get_running_loop()
        loop.add_reader(web.control, self._hear, web)
        loop.add_reader(web.ended, self._web_ended, web)

    def _gone(self, child: _Child) -> int:
        loop = asyncio.get_running_loop()
        loop.remove_reader(child.control)
        loop.remove_reader(child.ended)
        return child.release()

    def _rig_ended(self, rig: _Child) -> None:
        written = self._write_stop()
        self._hear(rig)  # its last messages
        status = self._gone(rig)
        self._keep_lines([])
        self._rig = None
        for waiting in self._asked.values():
            if not waiting.done():
                waiting.set_result({"number": 0, "elapsed_ms": 0.0} if written else {})
        if self._ending:
            return
        _log.error("the rig process has ended with status %s; the stage was stopped", status)
        self._start_again(rig, self._start_rig)

    def _web_ended(self, web: _Child) -> None:
        if self._rig is not None:
            self._rig.say({"do": "stop", "id": 0})
        self._hear(web)
        status = self._gone(web)
        self._web = None
        if self._ending:
            return
        self._failed_starts = 0 if self._web_ready else self._failed_starts + 1
        if self._front is None or self._failed_starts >= _OFTEN:  # it has written the reason
            self._finish(status if status > 0 else 1)
            return
        _log.error("the web process has ended with status %s; the stage was stopped", status)
        self._start_again(web, self._start_web)

    def _start_again(self, child: _Child, start: Callable[[], None]) -> None:
        """Start a process again; one that did not live long only after a pause."""

        def start_unless_ending() -> None:
            if not self._ending:
                start()

        pause_s = _PAUSE_S if time.monotonic() - child.since < _SOON_S else 0.0
        asyncio.get_running_loop().call_later(pause_s, start_unless_ending)

    # messages ---------------------------------------------------------------------------------------------------------

    def _hear(self, child: _Child) -> None:
        """Take every message that waits."""
        try:
            while (message := child.heard()) is not None:
                self._take(*message)
        except EOFError:
            asyncio.get_running_loop().remove_reader(child.control)

    def _take(self, message: Message, descriptors: list[int]) -> None:
        if "lines" in message:
            self._keep_lines(list(zip(descriptors, (stop.encode("ascii") for stop in message["lines"]), strict=False)))
            return
        if "ready" in message:
            self._ready(message["ready"])
        elif (waiting := self._asked.pop(message["of"], None)) is not None and not waiting.done():
            waiting.set_result(message)
        for descriptor in descriptors:
            os.close(descriptor)

    async def _ask(self, child: _Child | None, what: str, patience_s: float) -> Message | None:
        """Return a process' answer; None if there is none in time."""
        number = next(self._numbers)
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        try:
            if child is None or not child.say({"do": what, "id": number}):
                return None
            with contextlib.suppress(TimeoutError):
                return await asyncio.wait_for(answer, patience_s) or None
            return None
        finally:
            self._asked.pop(number, None)

    def _ready(self, about: Ready) -> None:
        self._web_ready = True
        if self._front is not None:  # the web process was started again
            return
        rights = HaltRights(self._plan.data, hosts=frozenset(about["hosts"]), keys_required=about["required"])
        self._front = Front(
            upstream=self._folder / "web",
            limits=ConnectionLimits(max_open=about["max_open"]),
            halt=self._halt,
            may_halt=functools.partial(rights.permits, scheme=self._plan.scheme),
            refused=lambda why: self._refused.update((why,)),
            tls=self._tls,
        )
        asyncio.get_running_loop().create_task(self._serve(self._front, about)).add_done_callback(_raised)

    async def _serve(self, front: Front, about: Ready) -> None:
        await front.start(self._listener)
        self._announce(about["name"], about["data"])
        self._notifier.ready(f"serves the {about['name']}")

    # the stage --------------------------------------------------------------------------------------------------------

    async def _halt(self, action: Halt) -> HaltMade:
        """Have the rig process stop the stage; stop it here if it does not answer."""
        began = time.perf_counter()
        asked = asyncio.create_task(self._ask(self._rig, action, _HALT_PATIENCE_S))
        await asyncio.wait({asked}, timeout=_RIG_ANSWERS_S[action])
        if not (asked.done() and asked.result()) and self._write_stop() and action == "stop":
            return HaltMade(0, 1e3 * (time.perf_counter() - began))
        answer = await asked
        if answer is None:
            raise HaltFailed(
                "The process that holds the stage does not answer; it is started again if it has ended.",
                code="rig_process_lost",
            )
        if "code" in answer:
            raise HaltFailed(answer["cause"], code=answer["code"], remedy=answer["remedy"])
        return HaltMade(answer["number"], answer["elapsed_ms"])

    def _keep_lines(self, lines: list[tuple[int, bytes]]) -> None:
        for descriptor, _ in self._lines:
            os.close(descriptor)
        self._lines = lines

    def _write_stop(self) -> bool:
        """Write the stop on the stage's lines from here; return True if each took it."""
        left = dict(self._lines)
        until = time.monotonic() + _WRITE_S
        broken = False
        while left and time.monotonic() < until:
            for descriptor, stop in list(left.items()):
                try:
                    left[descriptor] = stop[os.write(descriptor, stop) :]
                except BlockingIOError:
                    continue  # the others first
                except OSError as error:
                    _log.error("the stop could not be written: %s", error.strerror)
                    broken, left[descriptor] = True, b""
                if not left[descriptor]:
                    del left[descriptor]
            if left:
                time.sleep(0.001)
        return bool(self._lines) and not left and not broken

    # the end ----------------------------------------------------------------------------------------------------------

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            if self._refused and self._web is not None and self._web.say({"do": "count", "refused": self._refused}):
                self._refused.clear()
            if self._notifier.is_due() and (self._probe is None or self._probe.done()):
                self._probe = asyncio.create_task(self._probe_both())

    async def _probe_both(self) -> None:
        """Notify systemd that the service lives if both processes answer so."""
        answers = [await self._ask(child, "ping", 10.0) for child in (self._rig, self._web)]
        if all(answer is not None and answer.get("alive", True) for answer in answers):
            self._notifier.alive()
        else:
            _log.error("a part of the service does not answer or has ended; the watchdog is not notified")

    def _begin_end(self) -> None:
        """Stop the stage first of all, then let the service end; asked again, end at once."""
        if self._rig is not None:
            self._rig.say({"do": "stop", "id": 0, "ending": True})
        if self._ending and self._web is not None:
            self._web.process.kill()
        self._notifier.stopping()
        self._finish(0)

    def _finish(self, status: int) -> None:
        self._ending = True
        if not self._status.done():
            self._status.set_result(status)

    async def _end(self) -> None:
        if self._web is not None:
            self._web.say({"do": "end"})
        if self._front is not None:
            await self._front.close(_GRACE_S)
        await self._until(lambda: self._web is None, _WEB_ENDS_S)
        if self._rig is not None:
            self._rig.say({"do": "end"})
        await self._until(lambda: self._rig is None, _RIG_ENDS_S)

    async def _until(self, ended: Callable[[], bool], patience_s: float) -> None:
        deadline = time.monotonic() + patience_s
        while not ended() and time.monotonic() < deadline:
            await asyncio.sleep(0.01)


def _raised(task: asyncio.Task[None]) -> None:
    """Log an error of a task, which would end unseen."""
    if not task.cancelled() and task.exception() is not None:
        _log.error("serving failed", exc_info=task.exception())
