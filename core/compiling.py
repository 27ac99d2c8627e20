"""Report of the compilation of kernels, once per machine: it explains to a user why a start takes longer.

numba raises an event when it compiles, none for kernels that it finds on disk.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Any

CompileElsewhere = Callable[[str, str, Any], None]
"""Module and qualified name of a kernel, and numba's types of its arguments: returns once it is on disk, if it can."""

COMPILING = "compiling kernels, once per machine, about half a minute"
"""Text for the user."""


@contextlib.contextmanager
def report_compiling(report: Callable[[], None]) -> Iterator[None]:
    """Call ``report`` when the first kernel inside the block is about to be compiled; never if all are on disk.

    Parameters
    ----------
    report
        Called at most once, on the thread that compiles.
    """
    from numba.core import event  # slow to load, and needed for any computation

    class Listener(event.Listener):
        reported = False

        def on_start(self, event: Any) -> None:  # noqa: ARG002 - numba's own signature
            if not self.reported:
                self.reported = True
                report()

        def on_end(self, event: Any) -> None:
            """Do nothing: the end shows in the work's own progress."""

    listener = Listener()
    event.register("numba:compile", listener)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)  # type: ignore[no-untyped-call]


_elsewhere: list[CompileElsewhere] = []


@contextlib.contextmanager
def compile_elsewhere(compile_it: CompileElsewhere) -> Iterator[None]:
    """Have another process compile the kernels that are not on disk inside the block, and load them then.

    In the process that compiles it, a kernel rounds otherwise than where it is loaded from disk.

    Parameters
    ----------
    compile_it
        Called on the thread that needs a kernel; where the kernel is not on disk after it, it is compiled here.
    """
    _elsewhere.append(compile_it)
    try:
        yield
    finally:
        _elsewhere.remove(compile_it)


def ask_elsewhere(dispatcher: Any, arguments: Any) -> bool:
    """Have a kernel compiled as :func:`compile_elsewhere` says; return False where nothing was said.

    Listeners hear of it as of any compilation.
    """
    if not _elsewhere:
        return False
    from numba.core import event  # slow to load, and needed for any computation

    function = dispatcher.py_func
    heard = {"dispatcher": dispatcher, "args": arguments, "return_type": None}
    with event.trigger_event("numba:compile", data=heard):
        _elsewhere[-1](function.__module__, function.__qualname__, arguments)
    return True


class NotCompiledError(Exception):
    """A kernel is neither loaded nor on disk, where none may be compiled."""


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
