"""Basler's pylon, loaded when it is first needed.

pypylon has no types and is in the extra ``[pylon]`` only: nothing else in the project imports it.
"""

from __future__ import annotations

import functools
import warnings
from typing import Any

from stereorig.core.errors import CameraError


def pylon() -> Any:
    """Return the module of cameras and frames.

    Raises
    ------
    CameraError
        ``driver_missing`` when pypylon is not installed.
    """
    return _modules()[0]


def genapi() -> Any:
    """Return the module of features; its ``GenericException`` is the class of all of pylon's errors."""
    return _modules()[1]


def factory() -> Any:
    """Return the place where cameras are found and made."""
    return pylon().TlFactory.GetInstance()


@functools.cache
def _modules() -> tuple[Any, Any]:
    try:
        # its wrappers have no module's name: Python warns, and a program that makes errors of warnings ends in a crash
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            from pypylon import genicam, pylon
    except ImportError as error:
        raise CameraError(
            f"Basler's pylon cannot be used: {error}.",
            code="driver_missing",
            remedy="Install it: pip install 'stereorig[pylon]'.",
        ) from error
    return pylon, genicam
