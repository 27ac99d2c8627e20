"""GenICam descriptions with the traits of real cameras, behind a GigE Vision device that behaves by them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.fake_gige import what_is_missing
from tests.support.namespace import run_apart
from tests.support.requirements import missing

MTU = 8228  # as large as the packets of the laboratory's rig file
CLOCK = "ptp:1122334455667788"
LAB = "config/lab_aravis_esp301.toml"
DESCRIPTIONS = (
    "acquisition_mode_read_only",
    "floats_over_registers",
    "format_by_lookup",
    "gain_factor",
    "plain",
    "ptp_latched",
    "ptp_mode",
    "ptp_parent_latched",
    "sfnc1_raw",
    "trigger_alias",
    "trigger_armed_only",
    "trigger_burst_only",
)


@pytest.fixture(scope="module")
def looked(shared_dir: Path) -> dict[str, Any]:
    lacking = what_is_missing()
    if lacking is not None:
        missing(lacking)
    devices = shared_dir / "devices"
    files = [str(devices / "descriptions" / f"{name}.xml") for name in DESCRIPTIONS]
    inside = [sys.executable, "-m", "tests.support.described_cameras", str(devices), *files, LAB]
    loopback = f'ip link set lo up mtu {MTU}; ip addr add 127.0.0.2/8 dev lo; exec "$@"'
    done = run_apart("--net", "bash", "-c", loopback, "guest", *inside)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == len(DESCRIPTIONS) + 1, done.stderr[-2000:]
    return dict(zip((*DESCRIPTIONS, LAB), lines, strict=True))


@pytest.mark.fault(62)
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_a_camera_opens_and_does_all_that_its_description_has(looked: dict[str, Any], name: str) -> None:
    found = looked[name]
    assert found["depths"] == {"8": 8, "12": 12}
    # free again after the triggers: the rate's limit, off for their sake, is on again
    assert found["modes"] == {"free": [5, 5], "software": [5], "hardware": [5]}
    assert found["listed"] == ["Kaméra"]
    # the camera could 9000; such packets would pass in parts
    assert 1500 < int(found["packet"]) <= MTU
    assert (found["refused"], found["kept"]) == ("out_of_range", True)


def test_a_gain_is_given_in_decibels_only_if_it_is_known_what_the_camera_counts(looked: dict[str, Any]) -> None:
    gains = {
        name: (looked[name]["gain"], looked[name]["gain_range_db"]) for name in ("plain", "gain_factor", "sfnc1_raw")
    }
    assert gains["plain"] == ("dB", [0.0, 24.0])
    assert gains["sfnc1_raw"] == ("raw", None)
    assert gains["gain_factor"] == ("factor", [0.0, pytest.approx(24.0824, abs=1e-3)])  # 1 to 16


@pytest.mark.fault(62)
@pytest.mark.parametrize(("cam", "serial"), [("cam1", "21234567"), ("cam2", "21234568")])
def test_the_laboratorys_rig_file_suits_the_kind_of_camera_that_it_names(
    looked: dict[str, Any], cam: str, serial: str
) -> None:
    found = looked[LAB][cam]
    assert (found["serial"], found["shape"], found["packet"]) == (serial, [2048, 2448, 12], "8228")
    assert (found["pixel_format"], found["exposure_ms"], found["trigger"]) == ("Mono12", 8.0, "hardware")
    assert found["features"] == {"GammaEnable": False, "GainRaw": 0, "BlackLevelRaw": 0}


def test_a_cameras_temperature_is_that_near_its_sensor_and_a_number_that_is_none_is_not_known(
    looked: dict[str, Any],
) -> None:
    assert looked[LAB]["cam1"]["warm"] == [41.5, "2", 42.25, None]  # 2: the core board


def test_the_clock_that_rules_a_cameras_is_named_whatever_its_features_are_called(looked: dict[str, Any]) -> None:
    clocks = {name: found["clock"] for name, found in looked.items() if found.get("clock") is not None}
    # the third has a mode and a state, and no number of its master: two of its kind have no clock that is known as one
    assert clocks == {"ptp_latched": [CLOCK, True], "ptp_parent_latched": [CLOCK, True], "ptp_mode": ["", False]}
