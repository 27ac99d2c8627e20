"""One reading for many: never an old one, few of them, and errors for all who waited."""

from __future__ import annotations

import itertools
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from stereorig.core.errors import StageError
from stereorig.server.rig.shared import SharedReading


def test_a_caller_gets_a_reading_that_began_after_the_call() -> None:
    numbers = itertools.count()

    def read() -> tuple[int, float]:
        began = time.monotonic()
        time.sleep(0.002)
        return next(numbers), began

    reading = SharedReading(read)

    def ask(_: int) -> bool:
        asked = time.monotonic()
        return reading()[1] >= asked

    with ThreadPoolExecutor(16) as pool:
        assert all(pool.map(ask, range(400)))
    assert next(numbers) < 300  # shared, where one reading each would be 400


def test_callers_during_one_reading_share_the_next() -> None:
    begun, go_on = threading.Event(), threading.Event()
    readings = []

    def read() -> int:
        begun.set()
        go_on.wait(20.0)
        readings.append(len(readings))
        return readings[-1]

    reading = SharedReading(read)
    with ThreadPoolExecutor(9) as pool:
        first = pool.submit(reading)
        assert begun.wait(20.0)
        others = [pool.submit(reading) for _ in range(8)]
        time.sleep(0.2)  # they all wait
        go_on.set()
        assert first.result(20.0) == 0
        assert {other.result(20.0) for other in others} == {1}
    assert readings == [0, 1]


def test_all_callers_get_an_error_and_the_next_reading_is_free_of_it() -> None:
    answers = iter([StageError("The controller is silent.", code="stage_lost"), 7])

    def read() -> int:
        answer = next(answers)
        if isinstance(answer, StageError):
            raise answer
        return answer

    reading = SharedReading(read)
    with pytest.raises(StageError, match="silent"):
        reading()
    assert reading() == 7
