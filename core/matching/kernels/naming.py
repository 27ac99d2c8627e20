"""Compile kernels that factories make, under names of their own.

A compiled kernel's symbol is made of its qualified name, its argument types and a count that depends on what the
process compiled before. Two kernels from one factory may differ in none of the first two; loaded from the disk cache,
where they come from different processes, one could then stand for the other. So their names say what they are for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(made_for: str, **options: Any) -> Callable[[Any], Any]:
    """Compile as all kernels are, with ``made_for`` (what the factory was called with) in the name."""

    def compile_it(function: Any) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{made_for}"
        return njit(nogil=True, error_model="numpy", **options)(function)

    return compile_it
