"""Modules that are loaded when they are first used, and names of a package from such modules.

A package with both descriptions and computations is often needed for the description alone, as a calibration's file
that names its target: the modules that find targets in images then need not be loaded.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any


def load_module(name: str) -> ModuleType:
    """Load a module whose name a table or another process gives, as of a command or of a kernel."""
    return importlib.import_module(name)


def names_of(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    package
        Its name.
    modules
        The names that each of its modules gives.
    """
    lies_in = {name: f"{package}.{module}" for module, names in modules.items() for name in names}

    def get(name: str) -> Any:
        if name not in lies_in:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(load_module(lies_in[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted(lies_in)
