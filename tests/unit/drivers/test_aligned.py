"""Pairing by frame number aligned by time, and bringing a camera's clock to the host's."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stereorig.core.names import CameraName
from stereorig.drivers.acquisition.clocks import DeviceClock
from stereorig.drivers.acquisition.counter_offset import AlignedPairing
from stereorig.drivers.cameras.protocol import Frame

PERIOD_NS = 50_000_000
PIXELS = np.zeros((2, 2), np.uint8)


def frame(number: int, pulse: int, jitter_ns: int = 0) -> Frame:
    """A frame of one pulse; its device time identifies the pulse, its exposure time is what pairing may use."""
    at = pulse * PERIOD_NS
    return Frame(PIXELS, 8, number, at, at + jitter_ns, exposed_ns=at + jitter_ns)


@settings(max_examples=200, deadline=None)
@given(
    armed=st.tuples(st.integers(0, 3), st.integers(0, 3)),
    missed=st.lists(st.tuples(st.sampled_from(["cam1", "cam2"]), st.integers(5, 60)), max_size=4, unique=True),
    lost=st.lists(st.tuples(st.sampled_from(["cam1", "cam2"]), st.integers(5, 60)), max_size=4, unique=True),
    seed=st.integers(0, 1000),
)
def test_no_pair_ever_holds_two_pulses(
    armed: tuple[int, int], missed: list[tuple[CameraName, int]], lost: list[tuple[CameraName, int]], seed: int
) -> None:
    """Missed pulses are not counted by the camera; lost frames are. Arrivals jitter by less than half a period."""
    rng = np.random.default_rng(seed)
    pairing = AlignedPairing(period_ms=50.0, max_skew_ms=1000.0, common_clock=False)
    numbers = {"cam1": 7, "cam2": 1000}
    good = 0
    for pulse in range(70):
        order: list[CameraName] = ["cam1", "cam2"] if rng.random() < 0.5 else ["cam2", "cam1"]
        for cam in order:
            if pulse < armed[int(cam[-1]) - 1] or (cam, pulse) in missed:
                continue
            numbers[cam] += 1
            if (cam, pulse) in lost:
                continue
            pair = pairing.feed(cam, frame(numbers[cam], pulse, int(rng.integers(0, PERIOD_NS // 5))))
            if pair is not None and pair.accepted:
                good += 1
                assert pair.cam1.device_ns == pair.cam2.device_ns
    account = pairing.finish()
    assert account.triggered == account.paired + account.unpaired + account.incomplete + account.dropped
    assert good == account.paired - account.refused
    # a missed pulse costs its own pair and the one that shows it; a lost frame only its own
    assert good >= 70 - max(armed) - 3 * len(missed) - len(lost) - 1


def test_a_device_clock_is_brought_to_the_host_without_the_jitter_of_arrival() -> None:
    rng = np.random.default_rng(3)
    clock = DeviceClock()
    delay_ns, offset_ns, drift = 12_000_000, 7_000_000_000_000, 30e-6
    off = []
    for k in range(400):
        exposed = k * PERIOD_NS
        device = round(exposed * (1 + drift)) - offset_ns
        arrival = exposed + delay_ns + int(rng.exponential(4_000_000))
        off.append(clock.on_host(device, arrival) - exposed - delay_ns)
    late = np.array(off[20:]) / 1e6
    # the arrivals jitter by 4 ms; what is left is drift over the window and the shortest jitter seen
    assert late.max() < 0.5
    assert late.min() > -0.5


def test_a_clock_that_was_set_anew_is_followed() -> None:
    clock = DeviceClock()
    for k in range(100):
        clock.on_host(k * PERIOD_NS, k * PERIOD_NS + 5)
    later = 100 * PERIOD_NS
    assert clock.on_host(3, later) == later
    assert clock.on_host(3 + PERIOD_NS, later + PERIOD_NS) == later + PERIOD_NS
