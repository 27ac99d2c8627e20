"""Messages between rig process and web process: the same objects, large arrays by shared memory."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.errors import StageError
from stereorig.server.rig.process.wire import Channel


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel]]:
    made = tuple(map(Channel, socket.socketpair()))
    yield made  # type: ignore[misc]
    for end in made:
        end.close()


def test_arrays_of_any_size_type_and_layout_arrive_as_they_were(ends: tuple[Channel, Channel]) -> None:
    rng = np.random.default_rng(1)
    sent = [
        rng.integers(0, 256, (1001, 77), dtype=np.uint8),  # an odd number of bytes before the next one
        rng.integers(0, 65536, (700, 801), dtype=np.uint16),
        rng.normal(size=(3, 2)),
        rng.integers(0, 256, (600, 600), dtype=np.uint8)[::2, ::3],
        np.asfortranarray(rng.normal(size=(300, 200))),
        np.empty((0, 5)),
    ]
    sender = threading.Thread(target=ends[0].send, args=({"images": sent},))
    sender.start()
    received = ends[1].receive()["images"]
    sender.join()
    for one, other in zip(sent, received, strict=True):
        np.testing.assert_array_equal(one, other)
        assert other.dtype == one.dtype
        assert other.flags.aligned
        other[...] = 0  # as an array of this process' own
    assert int(sent[0].max()) > 0, "the sender's own is another one"


def test_no_descriptor_and_no_memory_stays_behind(ends: tuple[Channel, Channel]) -> None:
    known = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    for _ in range(20):
        sender = threading.Thread(target=ends[0].send, args=(np.ones((512, 512)),))
        sender.start()
        image = ends[1].receive()
        sender.join()
    del image
    assert len(os.listdir("/proc/self/fd")) == known  # noqa: PTH208
    assert "stereorig frames" not in Path("/proc/self/maps").read_text()


def test_an_error_keeps_code_remedy_and_context(ends: tuple[Channel, Channel]) -> None:
    ends[0].send((False, StageError("It has stopped.", code="stage_stopped", remedy="Look.", axes=[1])))
    whole, error = ends[1].receive()
    assert (whole, error.code, error.remedy, error.context) == (False, "stage_stopped", "Look.", {"axes": [1]})


def test_the_end_of_a_connection_is_no_message(ends: tuple[Channel, Channel]) -> None:
    assert not ends[1].waiting()
    ends[0].close()
    assert ends[1].waiting()
    with pytest.raises(EOFError):
        ends[1].receive()
