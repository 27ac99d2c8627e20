"""What the doctor makes of packets, links and the system's settings for them; tables as Linux writes them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereorig.drivers.cameras.genicam.link import interface_of
from stereorig.server.doctor.cameras import PairLog, check_ptp
from stereorig.server.doctor.link import check_link, check_network
from stereorig.server.doctor.report import Check, Notebook
from stereorig.server.rig.cameras import CapturedPair

# /proc/net/route: addresses in hex as a little-endian machine stores them
ROUTES = """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth0\t000200C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
cam0\t0001A8C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
cam1\t8001A8C0\t00000000\t0001\t0\t0\t0\t80FFFFFF\t0\t0\t0
"""


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    write(tmp_path / "net" / "route", ROUTES)
    write(tmp_path / "sys" / "net" / "core" / "rmem_max", "212992\n")
    return tmp_path


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("192.168.1.5", "cam0"),
        ("192.168.1.200", "cam1"),
        ("192.0.2.9", "eth0"),
        ("8.8.8.8", "eth0"),
        ("127.0.0.2", "lo"),
    ],
)
def test_packets_leave_by_the_closest_route(machine: Path, address: str, name: str) -> None:
    assert interface_of(address, machine) == name


def test_no_route_is_told(machine: Path) -> None:
    write(machine / "net" / "route", ROUTES.splitlines()[0] + "\n")
    assert interface_of("192.168.1.5", machine) is None


def unit(cam: str, address: str, share: str = "") -> Any:
    extra = {"protocol": "GigE Vision", "address": address, "packet_size_bytes": "1440", "link_share": share}
    asked = SimpleNamespace(features={"GevSCPD": 5} if share == "GevSCPD = 5" else None)
    return SimpleNamespace(name=cam, description=SimpleNamespace(extra=extra), wanted=asked, rate_hz=10.0)


def watched(mb_per_s: float, side: int = 512) -> PairLog:
    seen = PairLog(seconds=2.0)
    seen.link = {cam: {"transferred_bytes": 2.0e6 * mb_per_s} for cam in ("cam1", "cam2")}
    seen.frames = {cam: {"delivered": 20} for cam in ("cam1", "cam2")}
    image = np.zeros((side, side), np.uint8)
    seen.last = CapturedPair({"cam1": image, "cam2": image}, {"cam1": 8, "cam2": 8}, {}, 1, 1, 0.0, 0)
    return seen


def checked(
    machine: Path, seen: PairLog, *, speed: str, mtu: str, two: str = "192.168.1.6", shares: tuple[str, str] = ("", "")
) -> dict[str, Check]:
    for name in ("cam0", "cam1"):
        write(machine / "class" / name / "speed", speed)
        write(machine / "class" / name / "mtu", mtu)
    book = Notebook()
    units = {"cam1": unit("cam1", "192.168.1.5", shares[0]), "cam2": unit("cam2", two, shares[1])}
    check_network(book, units, seen, proc=machine, sys=machine / "class")  # type: ignore[arg-type]
    return {check.name: check for check in book.checks}


def test_two_cameras_on_one_link_load_it_together(machine: Path) -> None:
    found = checked(machine, watched(55.0), speed="1000\n", mtu="9000\n")
    assert found["cam0"].figures["load"] == pytest.approx(2 * 55.0 * 8 / 1000)
    assert found["cam0"].state == "warning"
    assert "88 % of 1000 Mbit/s" in found["cam0"].found
    assert "link of its own" in str(found["cam0"].remedy)


@pytest.mark.parametrize(
    ("shares", "rate_hz"),
    [
        # 80 % of 125 MB/s, halved; an image of 5 MB in 2500 packets with 66 bytes around each
        (("StreamBytesPerSecond = 50000000", "GevSCPD = 17736"), 5e7 / (5e6 + 66 * 2500)),
        (("DeviceLinkThroughputLimit = 70000000", "StreamBytesPerSecond = 30000000"), 3e7 / (5e6 + 66 * 2500)),
        (("DeviceLinkThroughputLimit = 70000000", "StreamBytesPerSecond = 50000000"), None),
        (("StreamBytesPerSecond = 50000000", "GevSCPD = 5"), None),  # a pause of the rig file's
        (("StreamBytesPerSecond = 50000000", ""), None),
    ],
)
def test_cameras_on_one_link_are_good_up_to_the_rate_that_their_shares_give(
    machine: Path, shares: tuple[str, str], rate_hz: float | None
) -> None:
    seen = watched(50.0)
    for counts in seen.link.values():
        counts["received_packets"] = 20 * 2500.0
    found = checked(machine, seen, speed="1000\n", mtu="9000\n", shares=shares)["cam0"]
    assert found.figures["safe_rate_hz"] == (rate_hz if rate_hz is None else pytest.approx(rate_hz))
    assert found.state == ("warning" if rate_hz else "ok")  # 10 images a second are asked for
    assert ("cam2 has none of DeviceLinkThroughputLimit, StreamBytesPerSecond, GevSCPD" in found.found) == (
        not shares[1]
    )
    calm = watched(5.0)
    calm.frames = {cam: {"delivered": 2000} for cam in calm.frames}
    assert checked(machine, calm, speed="1000\n", mtu="9000\n", shares=shares)["cam0"].state == "ok"
    calm.link["cam2"]["missing_packets"] = 3
    assert checked(machine, calm, speed="1000\n", mtu="9000\n", shares=shares)["cam0"].state == "warning"


def test_a_link_for_each_camera_is_good(machine: Path) -> None:
    found = checked(machine, watched(55.0), speed="1000\n", mtu="9000\n", two="192.168.1.200")
    assert found["cam0"].state == found["cam1"].state == "ok"
    assert found["cam1"].figures["load"] == pytest.approx(0.44)


def test_small_packets_at_a_high_rate_ask_for_jumbo_frames(machine: Path) -> None:
    found = checked(machine, watched(70.0), speed="10000\n", mtu="1500\n")
    assert found["cam0"].state == "warning"
    assert "mtu 9000" in str(found["cam0"].remedy)


def test_a_link_without_a_known_speed_has_no_limit(machine: Path) -> None:
    # the kernel's values for a link that is down, and of many virtual ones
    found = checked(machine, watched(20.0), speed="-1\n", mtu="1500\n")
    assert found["cam0"].state == "ok"
    assert found["cam0"].limit is None
    assert found["cam0"].figures["load"] is None


@pytest.mark.parametrize(("side", "state"), [(400, "ok"), (512, "warning")])
def test_socket_buffers_hold_an_image(machine: Path, side: int, state: str) -> None:
    found = checked(machine, watched(1.0, side), speed="1000\n", mtu="9000\n")
    assert found["socket buffers"].state == state


def test_a_camera_that_no_interface_leads_to(machine: Path) -> None:
    write(
        machine / "net" / "route", "\n".join(line for line in ROUTES.splitlines() if "cam" in line or "Iface" in line)
    )
    found = checked(machine, watched(1.0), speed="1000\n", mtu="9000\n", two="10.1.1.1")
    assert found["way to cam2"].state == "warning"


def test_what_went_wrong_on_the_way_is_named() -> None:
    seen = PairLog(seconds=1.0)
    seen.link = {
        "cam1": {"received_packets": 1000.0, "missing_packets": 3.0, "resent_packets": 0.0},
        "cam2": {"received_packets": 1000.0, "missing_packets": 0.0},
    }
    book = Notebook()
    for cam in ("cam1", "cam2"):
        check_link(book, SimpleNamespace(name=cam), seen)  # type: ignore[arg-type]
    assert [check.state for check in book.checks] == ["warning", "ok"]
    assert book.checks[0].found == "3 missing packets in 1000 packets"


@pytest.mark.parametrize(
    ("one", "two", "said"),
    [
        (("ptp:1", 0.001), ("ptp:1", 0.009), ""),
        (("ptp:1", 0.001), ("", 0.0), "cam2 follows no master that it names, its state is Listening"),
        (("ptp:1", 0.4), ("ptp:1", 0.0), "cam1 is 0.4 ms off its master, 0.01 ms are close"),
        (("ptp:1", 0.0), ("ptp:2", 0.0), "they follow different masters, ptp:1 and ptp:2"),
        (("monotonic", 0.1), ("monotonic", 0.1), ""),  # the kernel stamps both
    ],
)
def test_cameras_that_do_not_follow_one_master_closely_are_named_with_the_reason(
    one: tuple[str, float], two: tuple[str, float], said: str
) -> None:
    units = {
        cam: SimpleNamespace(
            description=SimpleNamespace(clock=clock, clock_error_ms=off_ms, extra={"ptp_status": "Listening"})
        )
        for cam, (clock, off_ms) in (("cam1", one), ("cam2", two))
    }
    book = Notebook()
    check_ptp(book, SimpleNamespace(units=units))  # type: ignore[arg-type]
    assert (book.checks[0].state, book.checks[0].found) == (
        ("warning", said) if said else ("ok", f"both follow {one[0]}")
    )
