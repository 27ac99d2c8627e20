"""Writes docs/openapi.json, the description of the API, and reports whether its version must be stepped.

``docs/openapi_released.json`` is the description of the last release. What differs from it in a way that breaks
clients needs a step of ``API_VERSION`` (server/api/docs/openapi.py); everything else only this script.

::

    python -m tests.bench.documents.openapi              # after each change of an operation
    python -m tests.bench.documents.openapi --release    # at a release: from now on this is what clients rely on
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from server.api.app import bare_app
from tests.bench.documents.api_changes import breaking_changes

DESCRIPTION = Path(__file__).resolve().parents[3] / "docs" / "openapi.json"
RELEASED = DESCRIPTION.with_name("openapi_released.json")


def current() -> dict[str, Any]:
    """Return the description of the code as it is."""
    return bare_app().openapi()


def text_of(description: dict[str, Any]) -> str:
    """Return the file's text."""
    return json.dumps(description, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def step_is_enough(released: str, now: str) -> bool:
    """Whether a version is far enough from the released one for a change that breaks clients.

    A new first number; while that is 0, a new second one.
    """
    before, after = ([int(part) for part in version.split(".")] for version in (released, now))
    if before[0] == 0:
        return after[:2] > before[:2]
    return after[0] > before[0]


def missing_step(released: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return the changes that break clients while the version is not stepped for them; empty when all is well."""
    if step_is_enough(released["info"]["version"], now["info"]["version"]):
        return []
    return breaking_changes(released, now)


def main(arguments: list[str]) -> int:
    """Write the file, unless the version must be stepped first."""
    now = current()
    released = json.loads(RELEASED.read_text(encoding="utf-8"))
    if broken := missing_step(released, now):
        print(
            f"These changes break clients of version {released['info']['version']}:",
            *(f"  {change}" for change in broken),
            "Take them back, or step API_VERSION in server/api/docs/openapi.py and run this again.",
            sep="\n",
            file=sys.stderr,
        )
        return 1
    DESCRIPTION.write_text(text_of(now), encoding="utf-8")
    print(f"{DESCRIPTION} is version {now['info']['version']}")
    if "--release" in arguments:
        RELEASED.write_text(text_of(now), encoding="utf-8")
        print(f"{RELEASED} is what clients rely on from now on")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
