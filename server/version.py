"""The software's version, as results carry it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def _version() -> str:
    try:
        return version("stereorig")
    except PackageNotFoundError:  # run from a checkout that was not installed
        return "0.1.0+checkout"


VERSION = _version()
