"""The version that results and the service report."""

from __future__ import annotations

import functools
from importlib import metadata
from pathlib import Path


@functools.cache
def software_version() -> str:
    """Return the installed distribution's version; if it is not installed, the source tree's."""
    try:
        return metadata.version("stereorig")
    except metadata.PackageNotFoundError:
        import tomllib  # imported late: only a source tree needs it

        project = Path(__file__).resolve().parents[2] / "pyproject.toml"
        return str(tomllib.loads(project.read_text())["project"]["version"])
