"""Every trigger has one fate, pairs are made of the right frames, and skew is checked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.frame_counter import Arrival, SequenceReader
from stereorig.drivers.acquisition.pairing import NumberPairing, Pair, TimePairing
from stereorig.drivers.cameras.protocol import Frame, FrameStatus

PERIOD_NS = 100_000_000


def frame(
    number: int,
    *,
    trigger: int | None = None,
    at_ns: int | None = None,
    status: FrameStatus = FrameStatus.OK,
    host_ns: int = 0,
) -> Frame:
    pixels = np.zeros((1, 1), np.uint8)
    return Frame(pixels, 8, number, number * PERIOD_NS if at_ns is None else at_ns, host_ns, status, trigger)


def pairing(**options: object) -> NumberPairing:
    return NumberPairing(**{"by": "frame", "max_skew_ms": 1.0, "common_clock": True, **options})  # type: ignore[arg-type]


def test_two_frames_of_one_number_make_a_pair_with_its_skew() -> None:
    pairs = pairing()
    assert pairs.feed("cam2", frame(0, at_ns=400_000)) is None
    pair = pairs.feed("cam1", frame(0, at_ns=0))
    assert pair is not None
    assert pair.skew_ms == pytest.approx(0.4)
    assert pair.accepted
    assert pair.require() is pair


def test_a_pair_above_the_skew_limit_is_refused_with_the_figure() -> None:
    pairs = pairing()
    pairs.feed("cam1", frame(0, at_ns=5_000_000))
    pair = pairs.feed("cam2", frame(0, at_ns=3_700_000))
    assert pair is not None
    assert not pair.accepted
    with pytest.raises(CameraError, match=r"1\.300 ms") as caught:
        pair.require()
    assert caught.value.code == "skew_too_large"
    account = pairs.finish()
    assert (account.paired, account.refused) == (1, 1)


def test_without_a_common_clock_the_skew_is_that_of_the_arrival() -> None:
    pairs = pairing(common_clock=False)
    pairs.feed("cam1", frame(0, at_ns=7, host_ns=1_000_000))
    pair = pairs.feed("cam2", frame(0, at_ns=10**15, host_ns=1_250_000))
    assert pair is not None
    assert pair.skew_ms == pytest.approx(0.25)


def test_pairing_by_trigger_ignores_frame_numbers_and_needs_triggers() -> None:
    pairs = pairing(by="trigger", origin={"cam1": 5, "cam2": 5})
    pairs.feed("cam1", frame(17, trigger=5, at_ns=0))
    pair = pairs.feed("cam2", frame(99, trigger=5, at_ns=0))
    assert pair is not None
    assert pair.number == 0
    with pytest.raises(CameraError) as caught:
        pairs.feed("cam1", frame(18))
    assert caught.value.code == "frame_format"


def test_triggers_whose_frames_never_came_are_known_when_the_caller_counts() -> None:
    pairs = pairing()
    pairs.triggered(3)
    assert pairs.finish().as_dict() == {
        "triggered": 3,
        "paired": 0,
        "unpaired": 0,
        "incomplete": 0,
        "dropped": 3,
        "refused": 0,
        "late": 0,
        "slips": 0,
    }


def test_what_comes_after_its_trigger_was_closed_is_late_and_changes_nothing() -> None:
    pairs = pairing(depth=2)
    for number in range(6):
        pairs.feed("cam1", frame(number))
    assert pairs.feed("cam2", frame(0)) is None
    assert pairs.feed("cam2", frame(5)) is not None
    account = pairs.finish()
    assert (account.triggered, account.paired, account.unpaired, account.late) == (6, 1, 5, 1)


FATE = st.sampled_from(["ok", "ok", "ok", "drop", "incomplete", "repeat", "late"])


@settings(max_examples=200, deadline=None)
@given(
    fates=st.lists(st.tuples(FATE, FATE), max_size=40),
    starts=st.tuples(st.integers(0, 65535), st.integers(0, 65535)),
    interleave=st.randoms(use_true_random=False),
)
def test_triggered_is_the_sum_of_its_fates_and_pairs_are_right(
    fates: list[tuple[str, str]], starts: tuple[int, int], interleave: object
) -> None:
    # What a camera sends, in order: its own 16-bit counter from anywhere, one number a trigger
    sent: dict[CameraName, list[tuple[int, Frame]]] = {"cam1": [], "cam2": []}
    arrived: dict[CameraName, set[int]] = {"cam1": set(), "cam2": set()}
    damaged: set[int] = set()
    for which, cam in enumerate(CAMERAS):
        for number, both in enumerate(fates):
            fate = both[which]
            if fate == "drop":
                continue
            made = frame(
                (starts[which] + number) % 2**16,
                at_ns=number * PERIOD_NS,
                status=FrameStatus.INCOMPLETE if fate == "incomplete" else FrameStatus.OK,
            )
            if fate == "incomplete":
                damaged.add(number)
            arrived[cam].add(number)
            at = len(sent[cam]) - 1 if fate == "late" and sent[cam] else len(sent[cam])
            sent[cam].insert(at, (number, made))
            if fate == "repeat":
                sent[cam].append((number, made))
    # The reader before the pairing takes out repeats and late frames, and unwraps the counter
    unwrap = {cam: SequenceReader() for cam in CAMERAS}
    for which, cam in enumerate(CAMERAS):
        unwrap[cam].read(starts[which])  # the number the first trigger would have, so that origins are known
    pairs = NumberPairing(
        by="frame", max_skew_ms=1.0, common_clock=True, origin=dict(zip(CAMERAS, starts, strict=True)), depth=100
    )
    made_pairs: list[Pair] = []
    kept: dict[CameraName, set[int]] = {"cam1": set(), "cam2": set()}
    queues = {cam: list(sent[cam]) for cam in CAMERAS}
    while queues["cam1"] or queues["cam2"]:
        cam = interleave.choice([cam for cam in CAMERAS if queues[cam]])  # type: ignore[attr-defined]
        number, made = queues[cam].pop(0)
        reading = unwrap[cam].read(made.sequence)
        if reading.arrival is Arrival.LATE or (reading.arrival is Arrival.DUPLICATE and number != 0):
            continue
        if number in kept[cam]:
            continue
        kept[cam].add(number)
        shown = Frame(made.pixels, 8, reading.number, made.device_ns, 0, made.status)
        if (pair := pairs.feed(cam, shown)) is not None:
            made_pairs.append(pair)
    pairs.triggered(len(fates))
    account = pairs.finish()
    assert account.triggered == len(fates)
    assert account.triggered == account.paired + account.unpaired + account.incomplete + account.dropped
    # each pair's frames were exposed by one trigger, so their times agree exactly
    assert all(pair.skew_ms == 0.0 and pair.accepted for pair in made_pairs)
    both = kept["cam1"] & kept["cam2"]
    bad = {n for n in damaged if n in kept["cam1"] | kept["cam2"] and _damaged_and_kept(n, fates, kept)}
    assert account.paired == len(made_pairs) == len(both - bad)
    assert account.incomplete == len(bad)
    assert account.unpaired == len((kept["cam1"] ^ kept["cam2"]) - bad)


def _damaged_and_kept(number: int, fates: list[tuple[str, str]], kept: dict[CameraName, set[int]]) -> bool:
    return any(fates[number][which] == "incomplete" and number in kept[cam] for which, cam in enumerate(CAMERAS))


@settings(max_examples=200, deadline=None)
@given(
    fates=st.lists(st.tuples(FATE, FATE), max_size=40),
    offset_ns=st.integers(-40_000_000, 40_000_000),
    jitter=st.randoms(use_true_random=False),
)
def test_pairing_by_time_never_mixes_two_occasions(
    fates: list[tuple[str, str]], offset_ns: int, jitter: object
) -> None:
    pairs = TimePairing(period_ms=PERIOD_NS / 1e6, max_skew_ms=60.0, common_clock=True, depth=100)
    queues: dict[CameraName, list[Frame]] = {"cam1": [], "cam2": []}
    for which, cam in enumerate(CAMERAS):
        for number, both in enumerate(fates):
            if both[which] == "drop":
                continue
            wobble = jitter.randint(-4_000_000, 4_000_000)  # type: ignore[attr-defined]
            status = FrameStatus.INCOMPLETE if both[which] == "incomplete" else FrameStatus.OK
            queues[cam].append(
                frame(number, at_ns=number * PERIOD_NS + which * offset_ns + wobble + 10**9, status=status)
            )
    expected = sum(both != ("drop", "drop") for both in fates)
    made = []
    while queues["cam1"] or queues["cam2"]:
        cam = jitter.choice([cam for cam in CAMERAS if queues[cam]])  # type: ignore[attr-defined]
        if (pair := pairs.feed(cam, queues[cam].pop(0))) is not None:
            made.append(pair)
    account = pairs.finish()
    assert all(pair.cam1.sequence == pair.cam2.sequence for pair in made)
    assert account.triggered == expected == account.paired + account.unpaired + account.incomplete + account.dropped


def test_a_camera_that_fell_silent_does_not_fill_the_memory() -> None:
    pairs = TimePairing(period_ms=100.0, max_skew_ms=1.0, common_clock=True, depth=4)
    for number in range(50):
        pairs.feed("cam1", frame(number))
    assert pairs.account.unpaired == 46
    pairs.missing(2)
    account = pairs.finish()
    assert (account.unpaired, account.dropped, account.triggered) == (50, 2, 52)


def test_senseless_options_are_refused() -> None:
    with pytest.raises(ValueError, match="max_skew_ms"):
        pairing(max_skew_ms=float("nan"))
    with pytest.raises(ValueError, match="period_ms"):
        TimePairing(period_ms=0.0, max_skew_ms=1.0, common_clock=True)
