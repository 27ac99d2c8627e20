"""Compile kernels, those that factories make under names of their own.

A compiled kernel's symbol consists of its qualified name, its argument types and a count that depends on the earlier
compilations of the process. Two kernels from one factory may have the same first two; loaded from the disk cache, which
different processes filled, one could then replace the other. So their names include their purpose.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from numba import njit

from stereorig.core.compiling import ENTRIES, CompiledElsewhereError, compiling_here, listen

#: without numba's runtime a kernel can make no array, and counts no references: two atomic instructions a view, on
#: counters that all threads share, were 5 us a point
_ALL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
_INNER: dict[str, Any] = {**_ALL, "no_cpython_wrapper": True}

outer = njit(**_ALL)
"""Compile a function that kernels call, and Python."""

inner = njit(**_INNER)
"""Compile a function that only kernels call: its wrapper for Python would take longer to compile than itself."""


class _Entry:
    """A kernel that Python calls, and that is kept on disk; no kernel can call it.

    A file of another version of the program may name classes of arguments that no longer exist, and cannot be read. It
    is emptied at the first call.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        self.compiled = njit(cache=True, **options)(function)
        self._not_kept = njit(**options)
        self._lock = threading.Lock()
        self._emptied = False

    def __call__(self, *arguments: Any) -> Any:
        """Run the kernel; :func:`stereorig.core.compiling.compile_elsewhere` compiles it if it is not on disk."""
        try:
            return self._run(arguments)
        except (AttributeError, ImportError):
            self._empty()
        return self._run(arguments)

    def _run(self, arguments: tuple[Any, ...]) -> Any:
        try:
            return self.compiled(*arguments)
        except CompiledElsewhereError:
            with compiling_here():
                return self.compiled(*arguments)

    def _empty(self) -> None:
        with self._lock:
            if self._emptied:
                return
            self._emptied = True
            try:
                self.compiled.recompile()  # of no signature: it empties the file
            except OSError:  # not ours to write: compile again in every process
                function = self.compiled.py_func
                del ENTRIES[function.__module__, function.__qualname__]
                self.compiled = self._not_kept(function)


def entry(function: Callable[..., Any], *, makes_arrays: bool = False) -> Any:
    """Compile a function that Python calls, and keep it on disk.

    A function that makes its own work space sets ``makes_arrays``; functions that it calls in its loops must not make
    any.
    """
    listen()
    made = _Entry(function, {**_ALL, "_nrt": makes_arrays})
    ENTRIES[function.__module__, function.__qualname__] = made
    return made


entry_with_arrays = partial(entry, makes_arrays=True)


def stamp_of(sources: Iterable[Path]) -> int:
    """Return a number that changes with any of these files: numba itself looks at an entry's own file alone."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).digest()
    return int.from_bytes(digest[:7], "big")


def kernel(made_for: str, **options: Any) -> Callable[[Any], Any]:
    """Compile as all kernels are, with ``made_for`` (the factory's arguments) in the name."""

    def compile_it(function: Any) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{made_for}"
        return njit(**_INNER, **options)(function)

    return compile_it
