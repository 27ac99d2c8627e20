"""Checks and warnings to know before an analysis' results are used; kept between requests if it has many steps.

For an analysis of few steps they are made at every request. For some thousand steps they take a second and are made
in the background; until they are known for the first time, a warning states that.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.problem import JobProblem
from stereorig.server.results.warnings.analysis import ResultWarning
from stereorig.server.results.warnings.checks import Checks, checks_if_changed, checks_of
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.worker.executor import WorkerDiedError
from stereorig.server.worker.resting import RestingWorker

_log = logging.getLogger("stereorig.service")
#: an ``analysis.json`` of more bytes is of many steps: each takes some 190
_MANY_BYTES = 8_000
#: of a thousand: checked in a process of its own, since a thread that works for seconds delays all answers
_LONG_BYTES = 200_000
#: by the first who asks
_WAIT_FIRST_S = 0.25
#: files may be replaced in place, which no folder's time shows; then only changed files are read again
_FRESH_S = 30.0
#: share of a processor that the checks may take
_SHARE = 0.2


@dataclass
class _KeptChecks:
    mark: object = None
    checks: Checks | None = None
    state: bytes | None = None
    problems: Mapping[str, object] | None = None
    at: float = 0.0
    took_s: float = 0.0
    running: Future[None] | None = field(default=None, repr=False)


class AnalysisChecks:
    """Checks of the analyses of one service."""

    def __init__(self, tests: TestStore) -> None:
        self._tests = tests
        self._lock = threading.Lock()
        self._kept: dict[tuple[str, str, bool], _KeptChecks] = {}
        self._process = RestingWorker()
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checks")

    def close(self) -> None:
        """End the background thread and its process."""
        self._beside.shutdown(wait=False, cancel_futures=True)
        self._process.close()

    def of(self, test_id: str, analysis_id: str, failed: Mapping[str, JobProblem] | None = None) -> Checks:
        """Return the checks of an analysis.

        Parameters
        ----------
        failed
            Steps that could not be measured, if the caller knows more than ``summary.json``.

        Raises
        ------
        FileFormatError, NotFoundError
            If an analysis of few steps does not exist or cannot be read.
        """
        folder = self._tests.analyses.path(test_id, analysis_id)
        problems = None if failed is None else {n: one.plain() for n, one in failed.items()}
        if (folder / "analysis.json").stat().st_size <= _MANY_BYTES:
            return checks_of(folder, problems)
        mark = self._mark(test_id, folder, problems)
        with self._lock:
            kept = self._kept.setdefault((test_id, analysis_id, problems is None), _KeptChecks())
            age_s = time.monotonic() - kept.at
            current = kept.checks is not None and kept.mark == mark and age_s < _FRESH_S
            rested = kept.checks is None or age_s > kept.took_s / _SHARE
            first = kept.checks is None and kept.running is None
            if not current and rested and kept.running is None:
                # a request that was begun before the service closes gets the last known checks
                with contextlib.suppress(RuntimeError):
                    kept.running = self._beside.submit(self._renew, kept, folder, problems, mark)
            running = kept.running
        if first and running is not None:
            with contextlib.suppress(TimeoutError, CancelledError):
                running.result(timeout=_WAIT_FIRST_S)
        return kept.checks or _NOT_YET

    def with_warnings(self, test_id: str, entries: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
        """Return entries of analyses in a list with their warnings; an unreadable analysis gets none."""
        made = []
        for entry in entries:
            found: list[dict[str, object]] = []
            with contextlib.suppress(FileFormatError, NotFoundError):
                found = self.of(test_id, str(entry["id"])).plain_warnings()
            made.append({**entry, "warnings": found})
        return made

    def _renew(self, kept: _KeptChecks, folder: Path, problems: Mapping[str, object] | None, mark: object) -> None:
        began = time.monotonic()
        found: Checks | None = None
        state: bytes | None = None
        try:
            known = kept.state if problems == kept.problems else None
            state, found = self._find(folder, problems, known)
            found = found or kept.checks
        except (StereorigError, OSError) as error:
            _log.info("analysis %s cannot be checked: %s", folder.name, error)
        finally:
            with self._lock:
                kept.running, kept.at, kept.took_s = None, time.monotonic(), time.monotonic() - began
                kept.mark, kept.checks = mark, found or Checks((), ())
                kept.state, kept.problems = state, problems

    def _find(
        self, folder: Path, problems: Mapping[str, object] | None, before: bytes | None
    ) -> tuple[bytes, Checks | None]:
        asked = folder, problems, before
        if (folder / "analysis.json").stat().st_size > _LONG_BYTES:
            with contextlib.suppress(WorkerDiedError):
                found: tuple[bytes, Checks | None] = self._process.submit(checks_if_changed, *asked).result()
                return found
        return checks_if_changed(*asked)

    def _mark(self, test_id: str, folder: Path, problems: Mapping[str, object] | None) -> object:
        """Return something cheap that differs whenever the checks may find something else."""
        test = folder.parent.parent
        places = (folder, folder / "analysis.json", folder / "summary.json", test / "test.json")
        return (*map(_changed_ns, places), self._tests.steps.mark(test_id), tuple(problems or ()))


def _changed_ns(path: Path) -> int:
    try:
        return os.stat(path).st_mtime_ns  # noqa: PTH116
    except OSError:
        return 0


_NOT_YET = Checks(
    (),
    (
        ResultWarning(
            "not_checked_yet",
            "warning",
            "The checks of its steps are being made.",
            "Read it again in some seconds, before its results are used.",
        ),
    ),
)
