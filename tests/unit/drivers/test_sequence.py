"""Frame counters are read right through wraps, gaps, repeats and late frames."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereorig.drivers.acquisition.frame_counter import Arrival, SequenceReader


def test_a_counter_of_sixteen_bits_goes_on_after_its_wrap() -> None:
    reader = SequenceReader()
    readings = [reader.read(raw) for raw in (65533, 65534, 65535, 0, 1)]
    assert [reading.number for reading in readings] == [65533, 65534, 65535, 65536, 65537]
    assert all(reading.arrival is Arrival.NEXT for reading in readings)
    assert sum(reading.missing for reading in readings) == 0


def test_a_counter_that_leaves_out_zero_shows_no_gap_at_its_wrap() -> None:
    reader = SequenceReader(first=1, last=65535)
    assert [reader.read(raw).missing for raw in (65534, 65535, 1, 2)] == [0, 0, 0, 0]


def test_a_gap_across_the_wrap_is_counted() -> None:
    reader = SequenceReader()
    reader.read(65534)
    reading = reader.read(2)
    assert (reading.arrival, reading.missing, reading.number) == (Arrival.NEXT, 3, 65538)


def test_repeats_and_late_frames_are_told_apart_also_across_the_wrap() -> None:
    reader = SequenceReader()
    for raw in (65533, 65535, 1):
        reader.read(raw)
    assert reader.read(1).arrival is Arrival.DUPLICATE
    late = reader.read(65534)
    assert (late.arrival, late.number) == (Arrival.LATE, 65534)
    assert reader.read(65534).arrival is Arrival.DUPLICATE
    assert reader.read(2).arrival is Arrival.NEXT


def test_a_number_the_counter_cannot_show_is_refused() -> None:
    with pytest.raises(ValueError, match="outside"):
        SequenceReader(first=1, last=10).read(0)
    with pytest.raises(ValueError, match="does not count"):
        SequenceReader(first=3, last=3)


@given(start=st.integers(0, 2**16 - 1), steps=st.lists(st.integers(1, 2**15 - 1), max_size=40))
def test_any_growing_counter_is_unwrapped_exactly(start: int, steps: list[int]) -> None:
    reader = SequenceReader()
    true = start
    reader.read(start)
    for step in steps:
        true += step
        reading = reader.read(true % 2**16)
        assert (reading.number, reading.missing, reading.arrival) == (true, step - 1, Arrival.NEXT)
