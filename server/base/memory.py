"""Memory that stays what it is over days: no pools that only grow, and no long pauses to look through old objects.

All of it is asked for and not insisted on; other systems than Linux with glibc do as they like.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc

# of malloc.h
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8
#: an image is larger, and goes back to the system when nobody needs it
_MAPPED_BYTES = 128 * 1024
#: by default each of forty threads gets one, and keeps what it once needed
_ARENAS = 2


def keep_memory_steady() -> None:
    """Set the allocator; call it before there are threads."""
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_ARENA_MAX, _ARENAS)
        # left alone, this threshold grows with what is freed, and images come to lie in the pools
        mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)


def hurry() -> None:
    """Let the garbage collector rest while modules are loaded, which all stay: a seventh of a start went into it."""
    gc.disable()


def settle() -> None:
    """Take what there is now, modules above all, out of the garbage collector's rounds: they last as long as we do."""
    gc.collect()
    gc.freeze()
    gc.enable()
