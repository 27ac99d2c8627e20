"""Report of the compilation of kernels, once per machine: it explains to a user why a start takes longer.

numba raises an event when it compiles, none for kernels that it finds on disk.
"""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

CompileElsewhere = Callable[[str, str, Any], None]
"""Module and qualified name of a kernel, and numba's types of its arguments: returns once it is on disk, if it can."""

COMPILING = "compiling kernels, once per machine, about half a minute"
"""Text for the user."""


ENTRIES: dict[tuple[str, str], Any] = {}
"""Kernels that Python calls and that are kept on disk, by module and qualified name."""

_reports: list[Callable[[], None]] = []
_elsewhere: list[CompileElsewhere] = []
_asked = threading.local()


class CompiledElsewhereError(Exception):
    """Another process was asked to compile the kernel that was called: call it again inside :func:`compiling_here`."""


@contextlib.contextmanager
def report_compiling(report: Callable[[], None]) -> Iterator[None]:
    """Call ``report`` when the first kernel inside the block is about to be compiled; never if all are on disk.

    Parameters
    ----------
    report
        Called at most once, on the thread that compiles.
    """
    listen()
    reported = False

    def report_once() -> None:
        nonlocal reported
        if not reported:
            reported = True
            report()

    with _entered(_reports, report_once):
        yield


@contextlib.contextmanager
def compile_elsewhere(compile_it: CompileElsewhere) -> Iterator[None]:
    """Have another process compile the kernels that are not on disk inside the block, and load them then.

    In the process that compiles it, a kernel rounds differently than if it is loaded from disk.

    Parameters
    ----------
    compile_it
        Called on the thread that needs a kernel; if the kernel is not on disk after the call, it is compiled here.
    """
    with _entered(_elsewhere, compile_it):
        yield


@contextlib.contextmanager
def compiling_here() -> Iterator[None]:
    """Ask no other process inside the block, on this thread."""
    _asked.before = True
    try:
        yield
    finally:
        _asked.before = False


@contextlib.contextmanager
def _entered(callbacks: list[Any], one: Any) -> Iterator[None]:
    callbacks.append(one)
    try:
        yield
    finally:
        callbacks.remove(one)


@cache
def listen() -> None:
    """Hear of each compilation from now on."""
    from numba.core import event  # slow to load: a process without kernels does without

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            _on_compilation(event.data["dispatcher"], event.data["args"])

        def on_end(self, event: Any) -> None:
            """Do nothing: the end shows in the work's own progress."""

    event.register("numba:compile", Listener())  # type: ignore[no-untyped-call]


def _on_compilation(dispatcher: Any, arguments: Any) -> None:
    """Report that numba is about to compile a function, and ask another process for a kernel that is kept on disk."""
    for report in _reports.copy():
        report()
    name = dispatcher.py_func.__module__, dispatcher.py_func.__qualname__
    if _elsewhere and name in ENTRIES and not getattr(_asked, "before", False):
        _elsewhere[-1](*name, arguments)
        raise CompiledElsewhereError


class NotCompiledError(Exception):
    """A kernel is neither loaded nor on disk, and compiling is not allowed here."""


def refuse_compiling() -> contextlib.AbstractContextManager[None]:
    """Raise :class:`NotCompiledError` inside the block where a kernel would have to be compiled."""

    def refuse() -> None:
        raise NotCompiledError

    return report_compiling(refuse)


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Let no garbage be collected inside the block: the compiler makes millions of objects that stay.

    For a process that does nothing but compile: an eighth less of its time, half as much again of its memory.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
