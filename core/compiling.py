"""Telling that kernels are being compiled: once per machine, for a while, and a user should know why nothing moves.

numba says when it compiles; kernels that it finds on disk make no such event.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

COMPILING = "compiling kernels, once per machine, about half a minute"
"""What to tell a user."""


@contextlib.contextmanager
def report_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` when the first kernel inside the block is about to be compiled; never if all are on disk.

    Parameters
    ----------
    tell
        Called at most once, on the thread that compiles.
    """
    from numba.core import event  # takes a while to load, and whoever computes needs it anyway

    class Listener(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:  # noqa: ARG002 - numba's own signature
            if not self.told:
                self.told = True
                tell()

        def on_end(self, event: Any) -> None:
            """Nobody waits for the end: the work's own progress shows it."""

    listener = Listener()
    event.register("numba:compile", listener)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)  # type: ignore[no-untyped-call]
