"""Two GigE Vision cameras with clocks and read-outs of their own, through Aravis: their skew, and what fires them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.fake_gige import what_is_missing
from tests.support.namespace import run_apart
from tests.support.requirements import missing


def inside(scenario: str, **options: Any) -> Any:
    """Run a scenario of `tests.support.timed_rig` in a network namespace."""
    lacking = what_is_missing()
    if lacking is not None:
        missing(lacking)
    program = [sys.executable, "-m", "tests.support.timed_rig", scenario, json.dumps(options)]
    loopback = 'ip link set lo up; ip addr add 127.0.0.2/8 dev lo; exec "$@"'
    done = run_apart("--net", "bash", "-c", loopback, "guest", *program)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
@pytest.mark.parametrize(("latch", "source"), [(True, "latch"), (False, "wire")])
def test_true_skews_are_reported_within_a_tenth_of_a_millisecond(latch: bool, source: str) -> None:
    found = inside("skews", latch=latch, skews_ms=[0.0, 0.2, 3.0])
    account = found.pop("account")
    assert account["triggered"] == sum(account[name] for name in ("paired", "unpaired", "incomplete", "dropped"))
    for true_ms, pairs in found.items():
        assert {pair["by"] for pair in pairs} == {source}
        for pair in pairs:
            assert abs(pair["ms"] - float(true_ms)) <= 0.1
            assert pair["accepted"] == (float(true_ms) <= 1.0)


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
@pytest.mark.parametrize(("masters", "source"), [([77, 77], "clock"), ([77, 78], "latch")])
def test_clocks_that_follow_one_master_after_the_arming_are_one_clock(masters: list[int], source: str) -> None:
    found = inside("ptp", masters=masters)
    assert found == ["latch", source, f"ptp:{masters[1]:016x}"]


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
@pytest.mark.parametrize(("master", "wait_s", "source"), [(5, 60.0, "clock"), (None, 1.0, "latch")])
def test_the_first_capture_waits_for_a_common_ptp_clock_and_says_if_there_is_none(
    master: int | None, wait_s: float, source: str
) -> None:
    found = inside("first_capture", master=master, wait_s=wait_s)
    said = "cam1 follows no master that it names, its state is Listening; skews have another source"
    assert found[0] == source
    assert found[1:] == ([] if master else [f"no common PTP clock 3.5 s after the arming: {said}"])


OFF_BY = {"ppm": 30.0, "offset_ns": 7_000_000_000, "readout_s": 0.02}
ACTION, STROBE = 'trigger = "action"', 'strobe_line = "Line2"'
FOLLOWING = {"camera": "ptp = true", "before": "[cam.ptp('Slave', 5) for cam in cams]"}


def true_skews_ms(found: dict[str, Any], count: int) -> list[float]:
    one, two = found["true"]
    return [abs(b - a) / 1e6 for a, b in zip(one[-count:], two[-count:], strict=True)]


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
@pytest.mark.parametrize("rig", ['trigger = "free"\nframe_rate_hz = 5.0', 'trigger = "software"'])
def test_a_camera_drives_the_other_by_its_strobe_line(rig: str) -> None:
    found = inside("captures", cameras=[{}, OFF_BY], rig=rig, cam1=STROBE)
    assert found["strobe"][0] == [2, 1, 1]  # Line2, output, exposure active
    for skew in found["captures"]:
        assert skew["skew_source"] == "latch"
        assert abs(skew["skew_ms"] - 0.02) <= 0.1


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
@pytest.mark.parametrize("broadcast", [True, False])
def test_one_action_command_fires_both_cameras_and_each_packet_of_it_is_on_the_wire(
    tmp_path: Path, broadcast: bool
) -> None:
    if shutil.which("tshark") is None:
        missing("tshark (apt install tshark)")
    rig = f"{ACTION}\naction_broadcast = {str(broadcast).lower()}"
    found = inside("witnessed", cameras=[{}, OFF_BY], rig=rig, count=4, file=str(tmp_path / "wire.pcapng"))
    assert found["answers"] == [{"actions_done": 4}, {"actions_done": 4}]
    for skew, true_ms in zip(found["captures"], true_skews_ms(found, 4), strict=True):
        assert abs(skew["skew_ms"] - true_ms) <= 0.1
    packets = found["packets"]
    assert {packet["malformed"] for packet in packets} == {""}
    commands = [packet for packet in packets if packet["command"]]
    targets = ["127.255.255.255"] if broadcast else ["127.0.0.1", "127.0.0.2"]
    assert [packet["dst"] for packet in commands] == targets * 4
    assert {(p["flags"], p["groupkey"], p["groupmask"], p["time"]) for p in commands} == {
        ("0x01", "0x00000001", "0x00000001", "")
    }
    assert len({packet["devicekey"] for packet in commands}) == 1
    acknowledged = sorted((p["req_id"], p["src"], p["status"]) for p in packets if p["ack"])
    numbers = sorted({packet["req_id"] for packet in commands})
    assert acknowledged == [(n, at, "0x0000") for n in numbers for at in ("127.0.0.1", "127.0.0.2")]


@pytest.mark.fault(63)
@pytest.mark.timeout(120)
def test_an_action_at_a_time_of_the_common_clock_fires_both_cameras_then_and_a_late_one_is_counted() -> None:
    found = inside("captures", cameras=[{}, {}], rig=f"{ACTION}\naction_lead_ms = 600.0", count=4, **FOLLOWING)
    assert found["answers"] == [{"actions_done": 4}, {"actions_done": 4}]
    assert [skew["skew_source"] for skew in found["captures"]] == ["clock"] * 4
    assert max(true_skews_ms(found, 4)) <= 0.001  # although each camera had the command at another time
    late = inside("captures", cameras=[{}, {}], rig=f"{ACTION}\naction_lead_ms = 0.001", **FOLLOWING)
    assert late["answers"] == [{"actions_late": 6}, {"actions_late": 6}]
    for skew, true_ms in zip(late["captures"], true_skews_ms(late, 6), strict=True):
        assert abs(skew["skew_ms"] - true_ms) <= 0.1


@pytest.mark.timeout(120)
def test_an_action_at_a_time_needs_one_master_for_both_cameras() -> None:
    apart = {**FOLLOWING, "before": "[cam.ptp('Master', k) for k, cam in enumerate(cams, 1)]"}
    found = inside("captures", cameras=[{}, {}], rig=f"{ACTION}\naction_lead_ms = 50.0", count=1, **apart)
    assert (found["captures"], found["answers"]) == (["no_common_clock"], [{}, {}])


@pytest.mark.fault(13)
@pytest.mark.timeout(900)
@pytest.mark.parametrize("count", [150, pytest.param(10_000, marks=pytest.mark.deep)])
def test_every_action_command_has_one_fate_however_many_commands_and_frames_are_lost(count: int) -> None:
    losses = {"deaf": 0.03, "lost": 0.02} if count < 1000 else {"deaf": 0.003, "lost": 0.002}
    found = inside("many", cameras=[losses, losses], rig=ACTION, count=count)
    account, true = found["account"], found["true"]
    assert {name: account[name] for name in true} == true
    assert true["triggered"] == true["paired"] + true["unpaired"] + true["dropped"]
    assert true["unpaired"] > 0
    assert sum(found["codes"].values()) == count
    assert set(found["codes"]) <= {"captured", "pair_incomplete"}  # three losses in a row
