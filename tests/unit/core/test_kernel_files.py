"""Kernels' files hold machine code alone: no kernel can be built from another one that was loaded."""

from __future__ import annotations

import gc
import importlib
import inspect
import pkgutil

from numba.core.dispatcher import Dispatcher

import core
from core.matching.kernels.naming import ENTRIES


def test_no_kernel_calls_one_that_is_kept_on_disk() -> None:
    for module in pkgutil.walk_packages(core.__path__, "core."):
        importlib.import_module(module.name)
    kept = {id(made): name for name, made in ENTRIES.items()}
    assert len(kept) > 15, "what is looked for"
    for made in [one for one in gc.get_objects() if isinstance(one, Dispatcher)]:
        used = inspect.getclosurevars(made.py_func)
        for called in (*used.nonlocals.values(), *used.globals.values()):
            assert id(called) not in kept, f"{made.py_func.__qualname__} calls {kept.get(id(called))}"
