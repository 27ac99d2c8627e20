"""Compile kernels, those that factories make under names of their own.

A compiled kernel's symbol is made of its qualified name, its argument types and a count that depends on what the
process compiled before. Two kernels from one factory may differ in none of the first two; loaded from the disk cache,
where they come from different processes, one could then replace the other. So their names include their purpose.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from llvmlite.binding import parse_assembly, parse_bitcode
from numba import njit

from core.compiling import ask_elsewhere

#: without numba's runtime a kernel can make no array, and counts no references: two atomic instructions a view, on
#: counters that all threads share, were 5 us a point
_ALL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
_INNER: dict[str, Any] = {**_ALL, "no_cpython_wrapper": True}

outer = njit(**_ALL)
"""Compile a function that kernels call, and Python."""

inner = njit(**_INNER)
"""Compile a function that only kernels call: its wrapper for Python would take longer to compile than itself."""

ENTRIES: dict[tuple[str, str], Any] = {}
"""What :func:`entry` has made, by module and qualified name."""


def entry(function: Callable[..., Any], *, makes_arrays: bool = False) -> Any:
    """Compile a function that Python calls, and keep it on disk.

    One that makes its work space itself ``makes_arrays``; what it calls in its loops must not. No kernel may call it:
    on disk is its machine code alone.

    What another version of the program left there may name classes of arguments that no longer exist; numba would then
    fail at every call. Such an entry is emptied here.
    """
    made = njit(cache=True, **{**_ALL, "_nrt": makes_arrays})(function)
    try:
        made._cache._cache_file._load_index()
    except (AttributeError, ImportError):
        try:
            made._cache.flush()
        except OSError:  # not ours to write: compile anew in every process
            made._cache.disable()
    if made._cache._enabled:
        _load_what_another_process_compiles(made)
        _keep_machine_code_alone(made)
    ENTRIES[function.__module__, function.__qualname__] = made
    return made


entry_with_arrays = partial(entry, makes_arrays=True)


def _load_what_another_process_compiles(made: Any) -> None:
    """Where a kernel is not on disk, ask for it as :func:`core.compiling.compile_elsewhere` says, and look again."""
    load = made._cache.load_overload

    def load_or_ask(arguments: Any, target: Any) -> Any:
        found = load(arguments, target)
        return load(arguments, target) if found is None and ask_elsewhere(made, arguments) else found

    made._cache.load_overload = load_or_ask


def _keep_machine_code_alone(made: Any) -> None:
    """Leave out of a kernel's file what it would be built into others from: reading that took most of the loading."""
    reduce = made._cache._impl.reduce

    def reduce_more(compiled: Any) -> Any:
        (name, kind, (machine_code, code)), *more = reduce(compiled)
        module = parse_bitcode(code)
        defined = [v.name for v in (*module.functions, *module.global_variables) if not v.is_declaration]
        names = parse_assembly("\n".join(f'@"{one}" = global i8 0' for one in defined))
        return ((name, kind, (machine_code, names.as_bitcode())), *more)

    made._cache._impl.reduce = reduce_more


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
