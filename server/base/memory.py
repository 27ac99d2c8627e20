"""Rounds of the garbage collector that spare what stays: no long pauses over old objects.

That memory stays what it is over days is the allocator's part: MALLOC_ARENA_MAX in the systemd unit.
"""

from __future__ import annotations

import gc


def hurry() -> None:
    """Let the garbage collector rest while modules are loaded, which all stay: a seventh of a start went into it."""
    gc.disable()


def settle() -> None:
    """Take what there is now, modules above all, out of the garbage collector's rounds: they last as long as we do."""
    gc.collect()
    gc.freeze()
    gc.enable()
