"""Rounds of the garbage collector that leave out lasting objects: no long pauses.

That memory does not grow over days depends on the allocator: MALLOC_ARENA_MAX in the systemd unit.
"""

from __future__ import annotations

import atexit
import gc


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
