"""Reading ahead and writing behind keep order and errors where a plain loop has them."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from stereorig.server.compute.overlap import ReadAhead, WriteBehind


def test_items_are_read_in_order_and_one_ahead() -> None:
    begun: list[int] = []
    second = threading.Event()

    def read(item: int) -> int:
        begun.append(item)
        if item == 1:
            second.set()
        return 10 * item

    with ReadAhead(read, range(4)) as ahead:
        assert next(ahead) == 0
        assert second.wait(10.0)  # read while 0 is in use
        assert begun == [0, 1]  # and no further
        assert list(ahead) == [10, 20, 30]
    assert begun == [0, 1, 2, 3]


def test_an_unreadable_item_fails_at_its_own_turn() -> None:
    def read(item: int) -> int:
        if item == 2:
            raise OSError("no such step")
        return item

    taken: list[int] = []
    with pytest.raises(OSError, match="no such step"), ReadAhead(read, range(5)) as ahead:
        taken.extend(ahead)
    assert taken == [0, 1]


def test_what_is_left_unread_is_not_read() -> None:
    begun: list[int] = []
    with ReadAhead(begun.append, range(100)) as ahead:
        next(ahead)
    assert len(begun) <= 2


def test_results_are_written_in_order_while_the_caller_goes_on() -> None:
    go = threading.Event()
    written: list[int] = []

    def write(item: int) -> int:
        assert go.wait(10.0)
        written.append(item)
        return -item

    with WriteBehind[int]() as behind:
        behind.put(write, 1)
        assert written == []  # the caller is here, the file is not
        go.set()
        behind.put(write, 2)
        behind.put(write, 3)
        assert behind.finish() == [-1, -2, -3]
    assert written == [1, 2, 3]


def test_a_failed_write_stops_the_caller_at_the_next_one() -> None:
    written: list[int] = []

    def write(item: int) -> None:
        if item == 2:
            raise OSError("disk full")
        written.append(item)

    def run() -> None:
        with WriteBehind[None]() as behind:
            for item in range(1, 10):
                behind.put(write, item)

    with pytest.raises(OSError, match="disk full"):
        run()
    assert written == [1]


def test_a_later_error_does_not_hide_a_failed_write_and_waits_for_a_good_one() -> None:
    def fail() -> None:
        raise OSError("disk full")

    def run(*call: Any) -> None:
        with WriteBehind[None]() as behind:
            behind.put(*call)
            raise RuntimeError("the next step went wrong")

    with pytest.raises(OSError, match="disk full"):
        run(fail)
    written: list[int] = []
    with pytest.raises(RuntimeError, match="the next step"):
        run(written.append, 1)
    assert written == [1]
