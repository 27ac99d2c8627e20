"""Acknowledgement that a copy of a test exists elsewhere: kept with the test, for operators who free space by hand."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass

from stereorig.core.errors import StateError
from stereorig.server.formats.manifest import known_sha256
from stereorig.server.store.folder import now_utc
from stereorig.server.store.tests.tests import TestStore


@dataclass(frozen=True)
class Content:
    """The parts of a test to copy: complete steps, result files, and the SHA-256 of all their checksums."""

    steps: int
    results: int
    sha256: str


def content_of(tests: TestStore, test_id: str) -> Content:
    """Return the numbers of a test's complete steps and result files, and the SHA-256 of all their checksums."""
    digest = hashlib.sha256()
    steps = tests.steps.numbers(test_id)
    for n in steps:
        digest.update(f"{n} {sorted(tests.steps.read(test_id, n).document.sha256.items())}\n".encode())
    results = 0
    for analysis_id in tests.analyses.ids(test_id):
        for n in tests.analyses.finished_steps(test_id, analysis_id):
            path = tests.analyses.path(test_id, analysis_id) / f"step_{n:04d}.nc"
            digest.update(f"{analysis_id} {n} {known_sha256(path)}\n".encode())
            results += 1
    return Content(len(steps), results, digest.hexdigest())


def acknowledge_export(tests: TestStore, test_id: str, *, steps: int, results: int, by: str) -> dict[str, object]:
    """Record with the test that a copy of it exists elsewhere; return the record.

    Raises
    ------
    NotFoundError
        There is no such test.
    StateError
        ``export_differs`` when the copy cannot hold all of it.
    """
    content = content_of(tests, test_id)
    if (content.steps, content.results) != (steps, results):
        raise StateError(
            f"The copy holds {steps} steps and {results} results, test {test_id} has {content.steps} and "
            f"{content.results}.",
            code="export_differs",
            remedy="Copy it again, then acknowledge that.",
            steps=content.steps,
            results=content.results,
        )
    exported = {"utc": now_utc(), "by": by, **asdict(content)}
    tests.update(test_id, {"exported": exported})
    return exported
