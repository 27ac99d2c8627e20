"""Skew by each source that proves it: latches of clocks, stamps of common pulses, a common clock, arrival."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.clocks import DeviceClock
from stereorig.drivers.acquisition.frame_counter import Arrival, SequenceReader
from stereorig.drivers.acquisition.pairing import NumberPairing, Pair
from stereorig.drivers.acquisition.simultaneity import Simultaneity
from stereorig.drivers.cameras.protocol import Frame, Latch

PERIOD_NS = 100_000_000
PIXELS = np.zeros((2, 2), np.uint8)


class Camera:
    """A camera with a clock of its own, whose frames arrive late."""

    def __init__(self, seed: int, *, offset_ns: int, ppm: float, delay_ns: int, latch: bool) -> None:
        self.rng = np.random.default_rng(seed)
        self.offset_ns, self.ppm, self.delay_ns, self.latch = offset_ns, ppm, delay_ns, latch
        self.clock = DeviceClock()

    def time_ns(self, host_ns: int) -> int:
        return host_ns + self.offset_ns + round(host_ns * self.ppm * 1e-6)

    def tie(self, host_ns: int) -> None:
        # the quickest of three, as the reader takes it
        ways = [tuple(int(self.rng.exponential(200_000)) + 50_000 for _ in range(2)) for _ in range(3)]
        there, back = min(ways, key=sum)
        if self.latch:
            self.clock.tie(Latch(host_ns, self.time_ns(host_ns + there), host_ns + there + back))

    def frame(self, number: int, begun_ns: int) -> Frame:
        device_ns = self.time_ns(begun_ns)
        host_ns = begun_ns + self.delay_ns + int(self.rng.exponential(1_000_000))
        latched = self.clock.latched(device_ns, host_ns) or (None, 0)
        exposed_ns = self.clock.on_host(device_ns, host_ns)
        return Frame(
            PIXELS,
            8,
            number,
            device_ns,
            host_ns,
            exposed_ns=exposed_ns,
            latched_ns=latched[0],
            latched_error_ns=latched[1],
        )


def pairs(
    skews_ms: list[float], *, latch: bool, wired: bool, common: float | None = None, hours: float = 0.0
) -> list[Pair]:
    """Pairs whose true skews are given, at read-outs that differ by 20 ms and clocks 7 s and 50 ppm apart."""
    known = Simultaneity(common=lambda: common, wired=wired, read_out_ms=lambda: 22.0)
    pairing = NumberPairing(by="frame", max_skew_ms=1.0, common_clock=known)
    one = Camera(1, offset_ns=0, ppm=-20.0, delay_ns=5_000_000, latch=latch)
    two = Camera(2, offset_ns=7_000_000_000, ppm=30.0, delay_ns=25_000_000, latch=latch)
    made = []
    for number, skew_ms in enumerate(skews_ms):
        now = 10**12 + round(hours * 3.6e12) + number * PERIOD_NS
        if number % 10 == 0:
            for k in range(8 if number == 0 else 1):
                for camera in (one, two):
                    camera.tie(now + k * 1_000_000)
        frames: dict[CameraName, Frame] = {
            "cam1": one.frame(number, now + 20_000_000),
            "cam2": two.frame(number, now + 20_000_000 + round(skew_ms * 1e6)),
        }
        found = [pairing.feed(cam, frames[cam]) for cam in CAMERAS]
        assert found[1] is not None
        made.append(found[1])
    return made


@pytest.mark.fault(63)
@pytest.mark.parametrize("skew_ms", [0.0, 0.2, 3.0, -3.0])
def test_latched_clocks_give_the_true_skew_whatever_the_read_outs(skew_ms: float) -> None:
    made = pairs([skew_ms] * 300, latch=True, wired=True)
    assert {pair.skew_source for pair in made[1:]} == {"latch"}
    for pair in made[1:]:
        assert abs(pair.skew_ms - skew_ms) <= pair.skew_uncertainty_ms
        assert pair.accepted == (abs(skew_ms) <= 1.0)
    assert max(abs(pair.skew_ms - skew_ms) for pair in made[20:]) <= 0.1


@pytest.mark.fault(63)
def test_stamps_of_common_pulses_show_each_pairs_jitter_without_a_common_clock() -> None:
    truth = [0.0] * 40 + [0.2, 0.0, 3.0, 0.0] * 10 + [3.0] * 100
    made = pairs(truth, latch=False, wired=True)
    assert {pair.skew_source for pair in made[:5]} == {"arrival"}
    for pair, skew_ms in list(zip(made, truth, strict=True))[5:]:
        assert pair.skew_source == "wire"
        assert abs(pair.skew_ms - skew_ms) <= 0.02
        assert pair.accepted == (skew_ms <= 1.0)


@pytest.mark.fault(63)
def test_arrival_refuses_no_pair_that_read_out_alone_may_have_parted() -> None:
    made = pairs([0.0] * 50, latch=False, wired=False)
    assert {(pair.skew_source, pair.skew_uncertainty_ms) for pair in made} == {("arrival", 22.0)}
    assert all(pair.accepted for pair in made[10:])
    assert not any(pair.accepted for pair in pairs([30.0] * 50, latch=False, wired=False))


def test_a_common_clock_that_is_seconds_off_is_none() -> None:
    assert {pair.skew_source for pair in pairs([0.0] * 5, latch=True, wired=False, common=0.0)[1:]} == {"latch"}


@pytest.mark.parametrize("late_s", [0.7, 1.5])
def test_a_frame_that_a_busy_host_takes_late_leaves_the_common_clock_believed(late_s: float) -> None:
    known = Simultaneity(common=lambda: 0.001, read_out_ms=lambda: 22.0)
    for number in range(9):
        begun_ns = number * PERIOD_NS
        late_ns = round(late_s * 1e9) if number in (4, 7) else 0
        frames: dict[CameraName, Frame] = {
            "cam1": Frame(PIXELS, 8, number, begun_ns, begun_ns + 5_000_000),
            "cam2": Frame(PIXELS, 8, number, begun_ns + 100_000, begun_ns + 25_000_000 + late_ns),
        }
        for cam in CAMERAS:
            known.see(cam, frames[cam])
        assert known.skew(frames) == (0.1, 0.001, "clock")


def test_a_clock_that_is_set_anew_is_tied_anew() -> None:
    camera = Camera(3, offset_ns=0, ppm=0.0, delay_ns=1_000_000, latch=True)
    for k in range(20):
        camera.tie(k * PERIOD_NS)
    camera.offset_ns = 5_000_000_000
    at = 20 * PERIOD_NS
    camera.tie(at)
    assert camera.frame(0, at).latched_ns is None  # a single reading may be wrong
    camera.tie(at + PERIOD_NS)
    latched = camera.frame(1, at + 2 * PERIOD_NS).latched_ns
    assert latched is not None
    assert abs(latched - at - 2 * PERIOD_NS) < 2_000_000


def test_a_register_that_keeps_no_time_is_no_clock() -> None:
    clock = DeviceClock()
    for k in range(10):
        clock.tie(Latch(k * PERIOD_NS, 4711, k * PERIOD_NS + 100_000))
        assert clock.latched(4711 + k, k * PERIOD_NS + 200_000) is None
    for k in range(10):  # counts in eighths of what it says
        clock.tie(Latch(k * PERIOD_NS, k * PERIOD_NS // 8, k * PERIOD_NS + 100_000))
        assert clock.latched(k * PERIOD_NS // 8, k * PERIOD_NS + 200_000) is None


def test_frames_of_a_driver_that_does_not_count_are_counted_here() -> None:
    reader = SequenceReader(0, 2**32 - 1)
    readings = [reader.read(0, fresh=fresh) for fresh in (False, True, True, False, True)]
    assert [(one.arrival, one.number) for one in readings] == [
        (Arrival.NEXT, 0),
        (Arrival.NEXT, 1),
        (Arrival.NEXT, 2),
        (Arrival.DUPLICATE, 0),
        (Arrival.NEXT, 3),
    ]
    assert reader.counts
