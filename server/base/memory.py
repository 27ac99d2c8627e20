"""Rounds of the garbage collector that leave out lasting objects: no long pauses.

That memory stays what it is over days is the allocator's part: MALLOC_ARENA_MAX in the systemd unit.
"""

from __future__ import annotations

import gc


def hurry() -> None:
    """Let the garbage collector rest while modules are loaded, which all stay: a seventh of a start went into it."""
    gc.disable()


def settle() -> None:
    """Take the present objects, modules above all, out of the garbage collector's rounds: they are never freed."""
    gc.collect()
    gc.freeze()
    gc.enable()
