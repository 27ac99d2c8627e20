"""A process for tasks that come now and then."""

from __future__ import annotations

import os
import time

import psutil
import pytest

from stereorig.core.errors import Cancelled
from stereorig.server.worker import resting
from stereorig.server.worker.resting import RestingWorker
from tests.support.patience import Deadline


def test_it_works_in_one_process_and_ends_it_after_a_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resting, "_REST_AFTER_S", 1.0)
    worker = RestingWorker()
    first = worker.submit(os.getpid).result(timeout=60.0)
    assert worker.submit(os.getpid).result(timeout=60.0) == first != os.getpid()
    assert worker.unfinished == 0
    deadline = Deadline(30.0)
    while psutil.pid_exists(first):
        assert deadline.left
        time.sleep(0.05)
    assert worker.submit(os.getpid).result(timeout=60.0) != first
    worker.close()


def test_after_its_end_it_refuses_tasks() -> None:
    worker = RestingWorker()
    running = worker.submit(time.sleep, 60.0)
    assert worker.unfinished == 1
    worker.close()
    with pytest.raises(Cancelled):
        running.result(timeout=30.0)
    with pytest.raises(Cancelled):
        worker.submit(os.getpid)
