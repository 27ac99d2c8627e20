"""Number of computing threads: kernels that release the GIL are run over ranges by :func:`run_ranges`.

numba's own parallel kernels (``prange``) are not used: its ``workqueue`` layer aborts the process when two threads run
such kernels at once.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

from stereorig.core.errors import InputError

_state_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None


def available_threads() -> int:
    """Return the largest number :func:`set_threads` takes: the processors this process may use, and one at least."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def threads() -> int:
    """Return the number of computing threads."""
    return _threads


def set_threads(n: int) -> None:
    """Compute on ``n`` threads from now on; results do not depend on it.

    Raises
    ------
    InputError
        If ``n`` is not between 1 and :func:`available_threads`.
    """
    global _threads, _pool
    if not 1 <= n <= available_threads():
        raise InputError(
            f"{n} threads asked for, 1 to {available_threads()} are possible here.",
            code="threads_out_of_range",
            remedy="Give a number of threads inside that range.",
        )
    with _state_lock:
        _threads = n
        if _pool is not None:
            _pool.shutdown(wait=False)  # running ranges are finished
            _pool = None


def run_ranges(function: Callable[[int, int], None], n: int, size: int, min_size: int | None = None) -> None:
    """Call ``function(first, last)`` over 0 ... n in ranges of ``size``, on all threads; the caller's is one of them.

    The first exception is raised again, once all threads have stopped.

    Parameters
    ----------
    function
        Function of the first and one past the last index.
    n, size
        End of the last range, and length of a range.
    min_size
        Length down to which the last ranges shrink, so that all threads end at about the same time; all are of one
        length when left out.
    """
    cuts = _cuts(n, size, min_size or size)
    ranges = iter(pairwise(cuts))
    take = threading.Lock()

    def work() -> None:
        while True:
            with take:
                item = next(ranges, None)
            if item is None:
                return
            function(*item)

    pending = _submit(work, min(_threads, len(cuts) - 1) - 1)
    try:
        work()
    finally:
        for future in pending:
            # a helper that has not begun has no work left; one that has is waited for, since it writes results
            if not future.cancel():
                future.exception()
    for future in pending:
        if not future.cancelled():
            future.result()


def _cuts(n: int, size: int, min_size: int) -> list[int]:
    cuts = [0]
    while cuts[-1] < n:
        left = n - cuts[-1]
        cuts.append(cuts[-1] + min(left, size, max(min_size, left // (2 * _threads))))
    return cuts


def _submit(work: Callable[[], None], helpers: int) -> list[Future[None]]:
    global _pool
    if helpers < 1:
        return []
    with _state_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=max(1, _threads - 1), thread_name_prefix="stereorig-compute")
        return [_pool.submit(work) for _ in range(helpers)]


_threads: int = available_threads()
