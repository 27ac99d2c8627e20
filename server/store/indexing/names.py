"""Names in folders of thousands of files, not read again while the folder is unchanged."""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict
from pathlib import Path

#: a folder's time may remain the same for some milliseconds while it changes
_SETTLED_NS = 1_000_000_000
_MANY = 500
_MAX_KEPT = 16

_lock = threading.Lock()
_kept: OrderedDict[str, tuple[tuple[int, int], tuple[str, ...]]] = OrderedDict()


def names_in(folder: Path) -> tuple[str, ...]:
    """Return the names of everything in a folder, in order; empty if there is no folder."""
    try:
        stat = folder.stat()
        mark, key = (stat.st_ino, stat.st_mtime_ns), str(folder)
        with _lock:
            known = _kept.get(key)
        if known is not None and known[0] == mark:
            return known[1]
        names = tuple(sorted(os.listdir(folder)))  # noqa: PTH208 - names, not paths
    except FileNotFoundError:
        return ()
    if len(names) >= _MANY and time.time_ns() - stat.st_mtime_ns > _SETTLED_NS:
        with _lock:
            _kept[key] = mark, names
            _kept.move_to_end(key)
            if len(_kept) > _MAX_KEPT:
                _kept.popitem(last=False)
    return names
