"""Threads of the numerical libraries: one each, since the program shares its work out over threads of its own.

Their matrices here are small; a second thread waits for them in a loop, and takes its processor from the fits.
"""

from __future__ import annotations

import os

_NAMES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_library_thread(*, asked: bool = True) -> None:
    """Let the libraries that this process and its children load compute on one thread; before they are imported.

    Parameters
    ----------
    asked
        Keep to a number that the environment asks for.
    """
    for name in _NAMES:
        if not (asked and name in os.environ):
            os.environ[name] = "1"
