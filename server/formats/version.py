"""The version that results and the service report."""

from __future__ import annotations

import functools
from importlib import metadata
from pathlib import Path


@functools.cache
def software_version() -> str:
    """Return the installed distribution's version, or that of the source tree it runs from."""
    try:
        return metadata.version("stereorig")
    except metadata.PackageNotFoundError:
        import tomllib  # loaded where it is used

        project = Path(__file__).resolve().parents[2] / "pyproject.toml"
        return str(tomllib.loads(project.read_text())["project"]["version"])
