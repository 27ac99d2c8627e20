"""Shares of a link: which cameras get one, by which feature, and what is left alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.acquisition import unit as units
from stereorig.drivers.acquisition.unit import CameraUnit, share_links
from stereorig.drivers.cameras.genicam.features import Bounds
from stereorig.drivers.cameras.genicam.link import held_back_by, hold_back
from stereorig.drivers.cameras.protocol import CameraSettings

GIGABIT = 125e6


class Features:
    """Integers by name, each with its range and step; a name of Aravis' own is no feature of the camera."""

    def __init__(self, **values: Any) -> None:
        self.values = values
        self.names = tuple(name for name in values if name != "GevSCPD" or values[name] != "of Aravis")
        self.ranges: dict[str, tuple[int, int, int]] = {}

    def has(self, name: str) -> bool:
        return name in self.values

    writable = has

    def first(self, *names: str) -> str | None:
        return next((name for name in names if self.has(name)), None)

    def kind(self, name: str) -> str:
        return "enumeration" if isinstance(self.values[name], str) else "integer"

    def entries(self, _name: str) -> tuple[str, ...]:
        return "Off", "On"

    def is_at(self, name: str, value: object) -> bool:
        return bool(self.values[name] == value)

    def bounds(self, name: str) -> Bounds:
        return Bounds(*self.ranges.get(name, (0, 2**32 - 1, 1)))

    def read_number(self, name: str) -> float:
        return float(self.values[name])

    def write(self, name: str, value: object) -> None:
        self.values[name] = value


@pytest.mark.parametrize(
    ("has", "held"),
    [
        (
            {"DeviceLinkThroughputLimitMode": "Off", "DeviceLinkThroughputLimit": 125_000_000, "GevSCPD": 0},
            "DeviceLinkThroughputLimit = 50000000",
        ),
        ({"StreamBytesPerSecond": 115_000_000, "GevSCPD": 0}, "StreamBytesPerSecond = 50000000"),
        # 1538 bytes every 30.76 us, of which they take 12.304 us; in ticks of 8 ns
        ({"GevSCPD": 0}, "GevSCPD = 2307"),
        # a camera of 10 Gbit/s behind a switch: they take 1.2304 us
        ({"GevSCPD": 0, "DeviceLinkSpeed": 1_250_000_000}, "GevSCPD = 3692"),
        # one of 100 Mbit/s cannot fill its share
        ({"GevSCPD": 0, "GevLinkSpeed": 100}, "GevSCPD = 0"),
        ({"GevSCPD": 0, "GevLinkSpeed": 0}, "GevSCPD = 2307"),
        ({"GevSCPD": "of Aravis"}, ""),
        ({}, ""),
    ],
)
def test_a_camera_is_held_back_by_the_first_of_three_features_that_it_has(has: dict[str, Any], held: str) -> None:
    features: Any = Features(GevSCPSPacketSize=1500, **has)
    hold_back(features, 0.4 * GIGABIT, GIGABIT, 125e6)
    assert held_back_by(features) == held


def test_a_share_stays_within_the_cameras_range_and_never_above_what_was_asked() -> None:
    features: Any = Features(StreamBytesPerSecond=115_000_000)
    features.ranges["StreamBytesPerSecond"] = 1_000_000, 124_000_000, 300_000
    hold_back(features, 50e6, GIGABIT, 1e9)
    assert held_back_by(features) == "StreamBytesPerSecond = 49900000"  # 1 MB/s and 163 steps
    hold_back(features, 0.5e6, GIGABIT, 1e9)
    assert held_back_by(features) == "StreamBytesPerSecond = 1000000"


class Grabber:
    """A camera on a link, with the share that it was given."""

    def __init__(self, address: str) -> None:
        self.held: list[tuple[float, float]] = []
        extra = {"protocol": "GigE Vision", "address": address}
        self._description = SimpleNamespace(
            extra=extra, serial="1", image_size_px=(8, 8), latency_s=0.0, counter_range=(1, 65535)
        )
        self.fault: CameraError | None = None

    def arm(self) -> None: ...

    open = disarm = close = arm

    def describe(self) -> Any:
        return self._description

    def configure(self, settings: CameraSettings) -> CameraSettings:
        # a camera that is held back reaches a part of the rate
        return CameraSettings(exposure_ms=1.0, frame_rate_hz=4.0 if self.held else settings.frame_rate_hz)

    def next_frame(self, _timeout_s: float) -> None: ...

    def statistics(self) -> dict[str, int]:
        return {}

    def trigger(self) -> None: ...

    def latch(self) -> None:
        raise CameraError("no clock", code="unknown_feature")

    renew_clock = latch

    def hold_back(self, bytes_per_s: float, link_bytes_per_s: float) -> None:
        self.held.append((bytes_per_s, link_bytes_per_s))
        if self.fault is not None:
            raise self.fault


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Grabber]]:
    """Grabbers that were made, by camera; the third number of an address is that of its interface."""
    monkeypatch.setattr(units, "interface_of", lambda address: f"eth{address.split('.')[2]}")
    monkeypatch.setattr(units, "speed_of", lambda name: None if name == "eth9" else GIGABIT)
    return {"cam1": [], "cam2": []}


def opened(bench: dict[str, list[Grabber]], addresses: tuple[str, str], **features: Any) -> list[CameraUnit]:
    made = []
    for cam, address in zip(bench, addresses, strict=True):

        def make(cam: str = cam, address: str = address) -> Any:
            bench[cam].append(Grabber(address))
            return bench[cam][-1]

        unit = CameraUnit(cam, make, trigger="free", rate_hz=10.0)  # type: ignore[arg-type]
        unit.open(CameraSettings(features=features or None))
        made.append(unit)
    share_links(made)
    return made


@pytest.mark.parametrize(
    ("addresses", "held"),
    [
        (("10.0.1.1", "10.0.1.2"), [(0.4 * GIGABIT, GIGABIT)]),
        (("10.0.1.1", "10.0.2.1"), []),
        (("10.0.9.1", "10.0.9.2"), []),  # the link's speed is not known
    ],
)
def test_only_cameras_on_one_link_of_known_speed_get_a_share(
    bench: dict[str, list[Grabber]], addresses: tuple[str, str], held: list[tuple[float, float]]
) -> None:
    for unit in opened(bench, addresses):
        assert bench[unit.name][0].held == held
        unit.release()


def test_a_camera_that_comes_back_has_its_share_again_and_the_other_is_left_alone(
    bench: dict[str, list[Grabber]],
) -> None:
    both = opened(bench, ("10.0.1.1", "10.0.1.2"))
    both[1].reconnect()
    both[1].resume()
    share_links(both)
    assert [len(grabber.held) for cam in bench for grabber in bench[cam]] == [1, 1, 1]
    assert both[1].wanted.frame_rate_hz == 4.0  # it would refuse the rate from before it was held back
    for unit in both:
        unit.release()


def test_a_share_in_the_rig_file_is_left_alone(bench: dict[str, list[Grabber]]) -> None:
    for unit in opened(bench, ("10.0.1.1", "10.0.1.2"), GevSCPD=100):
        assert bench[unit.name][0].held == []
        unit.release()


@pytest.mark.parametrize("code", ["out_of_range", "camera_lost"])
def test_a_camera_that_takes_no_share_works_on_and_one_that_is_lost_is_looked_for(
    bench: dict[str, list[Grabber]], code: str
) -> None:
    both = opened(bench, ("10.0.1.1", "10.0.9.1"))
    bench["cam1"][0].fault = CameraError("no", code=code)
    both[0].hold_back(1.0, 2.0)
    assert (both[0].fault is None) == (code == "out_of_range")
    for unit in both:
        unit.release()
