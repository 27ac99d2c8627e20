"""Reading of a client's files, as the service asks for it: bytes in, arrays and plain documents out, or one error."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import mmap
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stereorig.core.errors import Cancelled, FileFormatError, StereorigError
from stereorig.server.base.errors import QueueFullError, TooLargeError
from stereorig.server.cell.reply import ENDED, BrokenReplyError, read_reply
from stereorig.server.cell.sandbox import ReadingLimits

_log = logging.getLogger("stereorig.cell")
_AT_ONCE = 4
_MAX_WAITING = 12
_MODULE = "stereorig.server.cell.keeper"
_SEALS = 0x0001 | 0x0002 | 0x0004 | 0x0008  # no other seal, no shrinking, no growing, no writing
_ENVIRONMENT = ("PATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TMPDIR", "HOME", "NUMBA_CACHE_DIR")
_ONE_THREAD = ("OMP", "OPENBLAS", "MKL", "NUMBA", "TIFFFILE")
_EXIT_S = 60.0


class Cell:
    """Reads foreign files, each in a process of its own behind walls; see :mod:`stereorig.server.cell.sandbox`.

    The process that makes them is started with the first file, ends after some idle minutes, and is started again when
    it has ended.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(_AT_ONCE)
        self._asked = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Process id of the keeper, if it was started."""
        process = self._process
        return None if process is None else process.pid

    def read(
        self,
        function: Callable[..., Any],
        contents: Sequence[bytes | Path],
        *args: Any,
        of: str = "the file",
        limits: ReadingLimits = ReadingLimits(),  # noqa: B008 - frozen
    ) -> Any:
        """Return the value of ``function(files, *args)`` from a process that can open nothing.

        Parameters
        ----------
        function
            Function of a module; takes open binary files first, returns arrays and plain values.
        contents
            Contents of the files, or their paths.
        of
            Name in error messages.

        Raises
        ------
        StereorigError
            That the function raises.
        FileFormatError
            ``file_harmful`` if its reader crashes, or asks for a thing that it may not have.
        TooLargeError
            ``file_too_large`` if its reader needs more memory or time than it may take.
        QueueFullError
            ``reads_waiting`` if too many files wait.
        Cancelled
            After :meth:`close`.
        """
        with self._lock:
            if self._asked >= _AT_ONCE + _MAX_WAITING:
                raise QueueFullError(f"{self._asked} files are being read.", code="reads_waiting")
            self._asked += 1
        try:
            with self._room:
                return self._read(pickle.dumps((function, args, limits)), contents, of, limits)
        finally:
            with self._lock:
                self._asked -= 1

    def _read(self, message: bytes, contents: Sequence[bytes | Path], of: str, limits: ReadingLimits) -> Any:
        with contextlib.ExitStack() as held:
            reply = _held(held, os.memfd_create("reply", os.MFD_CLOEXEC))
            files = [_held(held, _opened(content)) for content in contents]
            # a keeper that ended is started again, once
            ended = self._ask(message, [reply, *files], limits) or self._ask(message, [reply, *files], limits)
            if self._closed:
                raise Cancelled("The service is shutting down.")
            if ended is None:
                raise _harmful(of, "the process that reads files ended twice")
            _check_end(of, limits, *ended)
            return _value_of(of, reply)

    def _ask(self, message: bytes, descriptors: list[int], limits: ReadingLimits) -> tuple[int, int, bool] | None:
        """Have a file read; return how the reader ended, None if the keeper did."""
        keeper = self._keeper()
        hears, says = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with hears, contextlib.suppress(OSError):  # of a keeper that is gone
            with says:
                socket.send_fds(keeper, [message], [says.fileno(), *descriptors])
            hears.settimeout(limits.wall_s + _EXIT_S)
            answer = hears.recv(ENDED.size)
            if len(answer) == ENDED.size:
                status, cpu_us, late = ENDED.unpack(answer)
                return status, cpu_us, late
        with self._lock:
            if keeper is self._control:
                self._end()
        return None

    def _keeper(self) -> socket.socket:
        with self._lock:
            if self._closed:
                raise Cancelled("The service is shutting down.")
            if self._control is None:
                ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
                environment |= {f"{name}_NUM_THREADS": "1" for name in _ONE_THREAD}
                environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
                with theirs:
                    self._process = subprocess.Popen(
                        [sys.executable, "-m", _MODULE, str(theirs.fileno())],
                        pass_fds=[theirs.fileno()],
                        env=environment,
                        stdin=subprocess.DEVNULL,
                    )
                self._control = ours
            return self._control

    def close(self) -> None:
        """End the process; reads on their way are cancelled."""
        with self._lock:
            self._closed = True
            self._end()

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._control = self._process = None


def require(held: bool, of: str) -> None:
    """Refuse a reader's value if it is of another kind than the reader's own.

    Raises
    ------
    FileFormatError
        ``file_harmful``.
    """
    if not held:
        raise _harmful(of, "its reader returned something else")


def _held(held: contextlib.ExitStack, descriptor: int) -> int:
    held.callback(os.close, descriptor)
    return descriptor


def _opened(content: bytes | Path) -> int:
    """Return a descriptor of a file's content, which cannot be changed through it."""
    if isinstance(content, Path):
        return os.open(content, os.O_RDONLY | os.O_CLOEXEC)
    made = os.memfd_create("content", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    with os.fdopen(made, "wb", 0, closefd=False) as file:
        left = memoryview(content)
        while left:
            left = left[file.write(left) :]
        file.seek(0)
    fcntl.fcntl(made, fcntl.F_ADD_SEALS, _SEALS)
    return made


def _check_end(of: str, limits: ReadingLimits, status: int, cpu_us: int, late: bool) -> None:
    """Raise an error for a reader that did not end by itself."""
    if late:
        raise _too_large(of, f"takes more than {limits.wall_s:g} s")
    ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if ended_by == signal.SIGXCPU or cpu_us >= 1e6 * limits.cpu_s:
        raise _too_large(of, f"takes more than {limits.cpu_s} s of processor time")
    if not ended_by:
        return
    if ended_by == signal.SIGKILL:  # the system's, for want of memory
        raise _too_large(of, "takes more memory than there is")
    raise _harmful(of, f"its reader was ended by {signal.Signals(ended_by).name}")


def _value_of(of: str, reply: int) -> Any:
    try:
        content = mmap.mmap(reply, 0, access=mmap.ACCESS_COPY)
        return read_reply(content)
    except StereorigError:
        raise
    except (BrokenReplyError, ValueError) as error:  # an empty reply cannot be mapped
        _log.warning("%s could not be read: %s", of, error)
        raise _harmful(of, f"its reader failed ({str(error).partition(':')[0]})") from error


def _harmful(of: str, cause: str) -> FileFormatError:
    return FileFormatError(
        f"{of[:1].upper()}{of[1:]} cannot be read: {cause}.",
        code="file_harmful",
        remedy="It is damaged, or was made to do harm: export it again, or ask who sent it. Nothing was kept.",
    )


def _too_large(of: str, cause: str) -> TooLargeError:
    return TooLargeError(
        f"Reading {of} {cause}.", code="file_too_large", remedy="Export it again, smaller; nothing was kept."
    )
