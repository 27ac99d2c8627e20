"""Retention: old tests go to the trash by themselves, but only those that somebody said are copied elsewhere.

Nothing is ever removed for good here. A clock that is wrong can therefore lose nothing: what went too early lies in the
trash until somebody empties it.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

from core.errors import StateError, StereorigError
from server.formats.files import known_sha256, recorded_sha256
from server.store.folder import now_utc
from server.store.tests import TestStore
from server.workflows.deletion import delete
from server.workflows.service import Service

_log = logging.getLogger("stereorig.retention")
_EVERY_S = 3600.0


def content_of(tests: TestStore, test_id: str) -> dict[str, Any]:
    """Return how many complete steps and result files a test has, and the SHA-256 of all their checksums."""
    digest = hashlib.sha256()
    steps = tests.step_numbers(test_id)
    for n in steps:
        digest.update(f"{n} {sorted(tests.step(test_id, n).document['sha256'].items())}\n".encode())
    results = 0
    for analysis_id in tests.analysis_ids(test_id):
        for n in tests.finished_steps(test_id, analysis_id):
            path = tests.analysis_path(test_id, analysis_id) / f"step_{n:04d}.nc"
            digest.update(f"{analysis_id} {n} {recorded_sha256(path) or known_sha256(path)}\n".encode())
            results += 1
    return {"steps": len(steps), "results": results, "sha256": digest.hexdigest()}


def acknowledge_export(service: Service, test_id: str, *, steps: int, results: int, by: str) -> dict[str, Any]:
    """Keep with the test that a copy of it lies elsewhere; return what was kept.

    Raises
    ------
    NotFoundError
        There is no such test.
    StateError
        ``export_differs`` when the copy cannot hold all of it.
    """
    content = content_of(service.tests, test_id)
    if (content["steps"], content["results"]) != (steps, results):
        raise StateError(
            f"The copy holds {steps} steps and {results} results, test {test_id} has {content['steps']} and "
            f"{content['results']}.",
            code="export_differs",
            remedy="Copy it again, then acknowledge that.",
            steps=content["steps"],
            results=content["results"],
        )
    exported = {"utc": now_utc(), "by": by, **content}
    service.tests.update(test_id, {"exported": exported})
    return exported


def is_over(tests: TestStore, test_id: str, days: float, now: datetime) -> bool:
    """Whether a test may go: acknowledged as copied elsewhere as it is now, and that so many days ago."""
    exported = tests.read(test_id).get("exported")
    if not isinstance(exported, dict):
        return False
    try:
        since = datetime.fromisoformat(str(exported["utc"]))
        if now - since < timedelta(days=days):
            return False
        return bool(content_of(tests, test_id)["sha256"] == exported["sha256"])
    except (KeyError, ValueError, TypeError):
        return False


def sweep(service: Service, *, now: Callable[[], datetime] = lambda: datetime.now(UTC)) -> list[str]:
    """Move every test whose time is over into the trash; return their ids."""
    days = service.config.service.retention_days
    gone: list[str] = []
    if days is None:
        return gone
    for test_id in service.tests.ids():
        try:
            if not is_over(service.tests, test_id, days, now()):
                continue
            ids = {"test_id": test_id}
            still = lambda test_id=test_id: is_over(service.tests, test_id, days, now())  # noqa: E731
            if delete(service, "test", ids, by="stereorig", why="retention", if_still=still) is not None:
                gone.append(test_id)
        except (StereorigError, OSError) as error:  # in use or damaged: it stays, and is looked at again
            _log.info("test %s stays: %s", test_id, error)
    if gone:
        _log.info("moved to the trash after %g days: %s", days, ", ".join(gone))
    return gone


class Retention:
    """Sweeps at the start and every hour, where the rig file asks for it."""

    def __init__(self, service: Service) -> None:
        self._ended = threading.Event()
        self._service = service
        if service.config.service.retention_days is not None:
            threading.Thread(target=self._run, name="retention", daemon=True).start()

    def _run(self) -> None:
        while True:
            sweep(self._service)
            if self._ended.wait(_EVERY_S):
                return

    def close(self) -> None:
        """Begin no further sweep."""
        self._ended.set()
