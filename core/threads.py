"""One lock and one number of threads for every parallel kernel of the project.

numba's ``workqueue`` layer aborts the process when two threads run parallel kernels at once, and the better layers may
be missing. So every call of a parallel kernel holds :data:`kernel_lock`.
"""

from __future__ import annotations

import threading

import numba

from core.errors import InputError

kernel_lock = threading.RLock()
"""Held around every call of a parallel kernel; reentrant, so a caller may hold it over several."""


def available_threads() -> int:
    """Return the largest number :func:`set_threads` takes in this process."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]  # set while numba is imported


def threads() -> int:
    """Return how many threads the kernels use."""
    with kernel_lock:
        return _threads


def set_threads(n: int) -> None:
    """Let the parallel kernels use ``n`` threads from now on; results do not depend on it.

    Raises
    ------
    InputError
        If ``n`` is not between 1 and :func:`available_threads`.
    """
    global _threads
    if not 1 <= n <= available_threads():
        raise InputError(
            f"{n} threads asked for, 1 to {available_threads()} are possible here.",
            code="threads_out_of_range",
            remedy="Give a number of threads inside that range (NUMBA_NUM_THREADS sets its upper end at start).",
        )
    with kernel_lock:
        _threads = n


def apply_threads() -> None:
    """Set the calling thread's number; numba keeps one per thread. Call with :data:`kernel_lock` held."""
    numba.set_num_threads(_threads)


_threads: int = available_threads()
