"""Priorities of the processes: a stop before a picture, a picture before an analysis.

The systemd unit sets them too. Started by hand, a user without the right to raise a priority runs the service at the
usual one. Linux may share the processors out by session first (autogroups), and by niceness only within a session.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
from pathlib import Path

_SERVICE_NICE = -10
_WORKER_NICE = 5
BELOW_WORKER, LAST = 12, 19
"""Niceness of work that the worker does not need yet, and of work that it needs later still."""
_SWITCH_S = 0.001
_PR_SET_PDEATHSIG = 1
_OOM_SCORE = "300"
_AUTOGROUP = Path("/proc/self/autogroup")


def raise_service() -> None:
    """Raise this process' priority where the system allows it (root, or a limit that permits it)."""
    # a thread that asks for the interpreter, such as a stop's, gets it after this long (Python's own value is 5 ms)
    sys.setswitchinterval(_SWITCH_S)
    _set_nice(_SERVICE_NICE)


def lower_worker(nice: int = _WORKER_NICE) -> None:
    """Lower this process' priority, in a session of its own: it would use up the share of the service's."""
    with contextlib.suppress(OSError, AttributeError):
        os.setsid()
    _set_nice(nice)


def _set_nice(nice: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
    # the session's share is ours to change only where we lead it; else it is a terminal's
    with contextlib.suppress(OSError, AttributeError):
        if os.getsid(0) == os.getpid():
            _AUTOGROUP.write_text(str(nice), encoding="ascii")


def raise_file_limit() -> None:
    """Allow this process as many open files, and so connections, as the system lets it have."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def die_first() -> None:
    """Let the kernel choose this process and its children when memory is out, not those that stop the stage."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE, encoding="ascii")


def end_with_parent(parent_pid: int | None = None) -> None:
    """End this process at once when the one that started it is gone, killed or not.

    ``parent_pid`` is needed if the parent did not use multiprocessing. A worker whose service was killed must not
    write into the files of the next service's worker. A thread that watches a pipe of the parent would be plainer, but
    late: it waits for the interpreter, and a result may be written before it runs.
    """
    parent = multiprocessing.parent_process()
    with contextlib.suppress(OSError, AttributeError):  # not on every system; elsewhere it ends with its task
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if parent_pid is None and parent is not None:
        parent_pid = parent.pid
    if parent_pid is not None and os.getppid() != parent_pid:
        os._exit(1)  # gone already


# Rounds of the garbage collector that leave out lasting objects: no long pauses.
#
# That memory does not grow over days depends on the allocator: MALLOC_ARENA_MAX in the systemd unit.


def hurry() -> None:
    """Pause the garbage collector while modules are loaded, which are never freed: it took a seventh of a start."""
    gc.disable()


def go_on() -> None:
    """End the pause; the objects loaded in it are left out of the rounds, and so is their little garbage."""
    gc.freeze()
    gc.enable()


def settle() -> None:
    """Exclude the present objects, modules above all, from the garbage collector's rounds: they are never freed."""
    gc.collect()
    go_on()


def end_at_once() -> None:
    """Leave out the collector's rounds over every module at this process' end: the system frees all of it anyway."""
    atexit.register(gc.disable)
    atexit.register(gc.freeze)
