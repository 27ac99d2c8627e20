"""Creation of both clients' connections."""

from __future__ import annotations

from typing import Any

import httpx

#: a job's wait is longer than most answers take
_LONGEST_WAIT_S = 60.0


def options_of(url: str, key: str | None, timeout_s: float) -> dict[str, Any]:
    """Return the options of an httpx client."""
    return {
        "base_url": f"{url.rstrip('/')}/api/v1/",
        "headers": {} if key is None else {"Authorization": f"Bearer {key}"},
        "timeout": httpx.Timeout(timeout_s, read=_LONGEST_WAIT_S + timeout_s),
        "trust_env": False,  # a rig is in the laboratory's own network, behind no proxy
        "follow_redirects": False,
    }
