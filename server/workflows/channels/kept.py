"""Readings of channels on disk, in the folder of the test that takes steps: bounded tables, whole at any kill."""

from __future__ import annotations

import csv
import io
import logging
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import StereorigError, StorageError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.store.tests.tests import TestStore

_log = logging.getLogger("stereorig.channels")

_BEFORE_S = 60.0  # readings before the first step that are kept with it
_TABLE_BYTES = 1 << 20  # the newest table is written again with each addition
_TABLES = 64
HEADER = "time_utc_s,host_s,channel,value\n"


class KeptReadings:
    """Writes readings into the folder of the test that took a step last.

    Parameters
    ----------
    tests
        The tests.
    require_room
        Raises if the disk is too full.
    """

    def __init__(self, tests: TestStore, require_room: Callable[[], None]) -> None:
        self._tests, self._require_room = tests, require_room
        self._lock = threading.Lock()
        self._test: str | None = None
        self._left: str | None = None  # whose last readings are still to be written
        self._from_s: dict[str, dict[str, float]] = {}
        self._since_s = 0.0
        self.is_new = False
        #: why the newest readings are not on disk; empty if they are
        self.problem = ""

    def attend(self, test_id: str, now_s: float) -> None:
        """Write into this test's folder from now on."""
        with self._lock:
            if test_id != self._test:
                self._left, self._test, self._since_s, self.is_new = self._test, test_id, now_s - _BEFORE_S, True

    def write(self, held: Mapping[str, tuple[Float, Float]]) -> None:
        """Write the readings since the last call, durably; those that cannot be written are tried again at the next."""
        with self._lock:
            left, test_id, since_s, self.is_new = self._left, self._test, self._since_s, False
            self._left = None
        for one in (left, test_id):
            try:
                if one is not None:
                    self._write(one, held, since_s if one == test_id else -np.inf)
                    self.problem = ""
            except NotFoundError:  # it was deleted
                self._forget(one)
            except StereorigError as error:
                if not self.problem:
                    _log.warning("readings of channels are not on disk: %s", error.cause)
                self.problem = error.cause

    def _forget(self, test_id: str | None) -> None:
        with self._lock:
            self._test = None if self._test == test_id else self._test

    def _write(self, test_id: str, held: Mapping[str, tuple[Float, Float]], since_s: float) -> None:
        done = self._from_s.setdefault(test_id, {})
        rows: list[tuple[float, str, float]] = []
        for name, (t, y) in held.items():
            begin = int(np.searchsorted(t, max(done.get(name, -np.inf), since_s), side="right"))
            rows += [(float(a), name, float(b)) for a, b in zip(t[begin:], y[begin:], strict=True)]
        if not rows:
            return
        zero_s, out = time.time() - time.monotonic(), io.StringIO()
        csv.writer(out, lineterminator="\n").writerows(
            (f"{zero_s + t:.6f}", f"{t:.6f}", name, f"{y:.12g}") for t, name, y in sorted(rows)
        )
        self._require_room()
        if not self._tests.add_readings(test_id, out.getvalue().encode(), HEADER.encode(), _TABLE_BYTES, _TABLES):
            raise StorageError(
                f"Test {test_id} holds {_TABLES} tables of readings.",
                code="readings_full",
                remedy="Make a new test; steps have their channels all the same.",
            )
        done |= {name: max(t for t, of, _ in rows if of == name) for name in {name for _, name, _ in rows}}
