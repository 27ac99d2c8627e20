"""Waiting for a worker's task."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace
from typing import Any, cast

import pytest

from stereorig.core.errors import Cancelled
from stereorig.server.jobs.job import Job
from stereorig.server.worker.executor import TaskFuture
from stereorig.server.workflows.waiting import result_of


def job(*, cancelled: bool = False) -> Job:
    def waiting(_stop: Any) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    record = SimpleNamespace(kind="analysis")
    return cast(Job, SimpleNamespace(cancelled=cancelled, waiting=waiting, record=record, progress=None))


class EndsWhileLookedAt(TaskFuture):
    """A task that ends between a wait that ran out and the look whether it has ended."""

    def done(self) -> bool:
        if not super().done():
            self.set_result("measured")
        return super().done()


def test_a_task_that_ends_as_a_wait_runs_out_has_its_result() -> None:
    assert result_of(EndsWhileLookedAt(), job()) == "measured"


def test_a_timeout_of_the_task_itself_is_its_error() -> None:
    future = TaskFuture()
    future.set_exception(TimeoutError("the camera is silent"))
    with pytest.raises(TimeoutError, match="the camera is silent"):
        result_of(future, job())


def test_a_task_of_a_cancelled_job_that_had_not_begun_is_cancelled() -> None:
    with pytest.raises(Cancelled):
        result_of(TaskFuture(), job(cancelled=True))
