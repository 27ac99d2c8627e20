"""Watch mode: a step at each change of a channel that a script posts.

The watched channel is stored in the test's folder, and a change is measured from the channel's value in the newest step
that has one: both outlive a restart, and a reading that asked for a step and got an error asks again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from stereorig.core.errors import StateError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.steps import StepMetadata, Watched, WatchRecord
from stereorig.server.store.durable import read_json, read_record, write_json
from stereorig.server.store.folder import now_utc
from stereorig.server.workflows.capture import capture_step
from stereorig.server.workflows.service import Service

#: watched like any channel, and kept in the steps' own field
LOAD = "load_n"


def value_of(step: StepMetadata, channel: str) -> float | None:
    """Value of a channel in a step's document, or in a reading's; None if it has none."""
    return step.load_n if channel == LOAD else step.channels.get(channel)


@dataclass(frozen=True)
class ReadingOutcome:
    """Outcome of a reading.

    Parameters
    ----------
    reason
        ``first`` reading of the channel or ``changed`` enough: a step was taken. ``below_threshold`` or
        ``channel_absent``: none was.
    value, last_value
        Value of the watched channel now, and at the step that it is compared with.
    n
        Number of the step that was taken.
    """

    reason: str
    value: float | None
    last_value: float | None
    n: int | None = None


class Watches:
    """The watches of one data folder's tests; one reading of a test at a time."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._guard = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        self._known: dict[tuple[str, str], tuple[tuple[int, int], tuple[int, float] | None]] = {}

    def _turn(self, test_id: str) -> threading.Lock:
        with self._guard:
            return self._locks.setdefault(test_id, threading.Lock())

    def begin(
        self, test_id: str, settings: Mapping[str, object], allow: Callable[[WatchRecord | None], None] | None = None
    ) -> WatchRecord:
        """Watch a channel from now on, in place of the one watched before.

        Parameters
        ----------
        allow
            Called with the present watch, None if there is none; raises an error if it must not be replaced.
        """
        with self._turn(test_id):
            if allow is not None:
                there = (self._service.tests.path(test_id) / "watch.json").is_file()
                allow(self.read(test_id) if there else None)
            document = {**settings, "active": True, "since_utc": now_utc()}
            write_json(self._service.tests.path(test_id) / "watch.json", document)
        return self.read(test_id)

    def end(self, test_id: str) -> WatchRecord:
        """Take no further steps."""
        with self._turn(test_id):
            path = self._service.tests.path(test_id) / "watch.json"
            if self._record(test_id).active:
                write_json(path, {**read_json(path), "active": False})
        return self.read(test_id)

    def _record(self, test_id: str) -> WatchRecord:
        path = self._service.tests.path(test_id) / "watch.json"
        if not path.is_file():
            raise NotFoundError(
                f"Nothing is watched in test {test_id}.", kind="watch", remedy="PUT /tests/{id}/watch with a channel."
            )
        return read_record(WatchRecord, path)

    def read(self, test_id: str) -> WatchRecord:
        """Return the watch with its channel's last value and step, which the next reading is compared with.

        Raises
        ------
        NotFoundError
            If the test was never watched.
        """
        watch = self._record(test_id)
        last = self._last(test_id, watch.channel)
        n, value = (None, None) if last is None else last
        return watch.model_copy(update={"last_value": value, "last_step": n})

    def _last(self, test_id: str, channel: str) -> tuple[int, float] | None:
        """Newest step that has a value of a channel, and the value; kept until there are other steps."""
        mark = self._service.tests.steps.mark(test_id)
        known = self._known.get((test_id, channel))
        if known is None or known[0] != mark:
            known = mark, self._newest(test_id, channel)
            self._known[test_id, channel] = known
        return known[1]

    def _newest(self, test_id: str, channel: str) -> tuple[int, float] | None:
        tests = self._service.tests
        for n in tests.steps.newest(test_id):
            value = value_of(tests.steps.read(test_id, n).document, channel)
            if value is not None:
                return n, value
        return None

    def reading(self, test_id: str, metadata: StepMetadata) -> ReadingOutcome:
        """Take a step if the watched channel has changed enough.

        Parameters
        ----------
        metadata
            The reading as a step's document will hold it: ``label``, ``load_n``, ``channels``, ``timestamp_utc``.

        Raises
        ------
        StateError
            ``watch_off`` when nothing is watched; ``hardware_busy`` when a job holds the cameras.
        CameraError, StorageError
            No step was taken; the same reading may be sent again.
        """
        with self._turn(test_id):
            watch: WatchRecord | None = None
            try:
                watch = self._record(test_id)
            except NotFoundError as error:
                if error.context.get("kind") != "watch":
                    raise
            if watch is None or not watch.active:
                raise StateError(
                    f"Nothing is watched in test {test_id}: the reading would be lost.",
                    code="watch_off",
                    remedy="PUT /tests/{id}/watch with a channel, or POST /tests/{id}/steps.",
                )
            channel, threshold = watch.channel, watch.threshold
            value, last = value_of(metadata, channel), self._last(test_id, channel)
            last_value = None if last is None else last[1]
            if value is None:
                return ReadingOutcome("channel_absent", None, last_value)
            change = None if last_value is None else abs(value - last_value)
            if change is not None and (change < threshold or change == 0.0):
                return ReadingOutcome("below_threshold", value, last_value)
            why = Watched(channel=channel, value=value, last_value=last_value, threshold=threshold)
            taken = metadata.model_copy(update={"label": metadata.label or watch.label or "", "watch": why})
            step = capture_step(self._service, test_id, taken, frames=watch.frames)
            return ReadingOutcome("first" if last is None else "changed", value, last_value, step.n)
