"""The address of a GigE Vision camera, given by its MAC address to one that no packet would reach."""

from __future__ import annotations

import json
import sys

from tests.support.fake_gige import what_is_missing
from tests.support.moved_camera import HERE, MAC
from tests.support.namespace import run_apart
from tests.support.requirements import missing


def test_a_camera_in_another_network_gets_an_address_in_this_one_and_keeps_it() -> None:
    lacking = what_is_missing()
    if lacking is not None:
        missing(lacking)
    inside = f"ip link set lo up; exec {sys.executable} -m tests.support.moved_camera"
    done = run_apart("--net", "bash", "-c", inside, timeout_s=120.0)
    assert done.stdout, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["before"] == ["It does not answer at its address: give it one by stereorig devices --set-address."]
    assert found["taken"] == "camera_lost"  # another device answers there
    assert found["wrong"] == ["invalid_input", "invalid_input", "camera_lost"]
    assert found["unmoved"] == []
    assert found["said"] == f"{MAC} has {HERE}/8 now, and after it is switched on again."
    assert found["forced"] == found["kept"] == [HERE, "255.0.0.0", "0.0.0.0"]
    assert found["after"] == [[HERE, None]]
