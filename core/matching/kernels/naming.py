"""Compile kernels, those that factories make under names of their own.

A compiled kernel's symbol is made of its qualified name, its argument types and a count that depends on what the
process compiled before. Two kernels from one factory may differ in none of the first two; loaded from the disk cache,
where they come from different processes, one could then replace the other. So their names include their purpose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_ALL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INNER: dict[str, Any] = {**_ALL, "no_cpython_wrapper": True}

inner = njit(**_INNER)
"""Compile a function that only kernels call: its wrapper for Python would take longer to compile than itself."""
entry = njit(cache=True, **_ALL)
"""Compile a function that Python calls, and keep it on disk."""


def kernel(made_for: str, **options: Any) -> Callable[[Any], Any]:
    """Compile as all kernels are, with ``made_for`` (the factory's arguments) in the name."""

    def compile_it(function: Any) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{made_for}"
        return njit(**_INNER, **options)(function)

    return compile_it
