"""Controllers by their published answers: each opens, and is who it says it is."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from stereorig.drivers.registry import STAGE_DRIVERS
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_stage import SerialStage, longest_search_s

CONTROLLERS = ("SMC100CC", "CONEX-CC, USB", "CONEX-CC with", "ESP300", "ESP302", "ESP7000")
ESP7000 = {
    "controller": "ESP7000",
    "driver": "esp301",
    "axis": 1,
    "answers": {
        "VE?": "ESP7000 Version 2.2 08/07/00",
        **{"1ID?": "UTM150CC.1, SN0000", "1SN?": "2", "1SL?": "-75", "1SR?": "75", "1VA?": "4", "1AC?": "16"},
        **{"1MD?": "1", "1MO?": "0", "1TP": "0.5", "TB?": "0, 1, NO ERROR DETECTED", "1VU?": "20", "1AU?": "80"},
    },
    "identity": {"model": "ESP7000", "firmware": "2.2"},
    "state": "motor_off",
}


def controllers(shared: Path) -> dict[str, dict[str, Any]]:
    known = json.loads((shared / "devices" / "dialogues" / "stages.json").read_text())["opens"]
    return {name: one for name in CONTROLLERS for one in [*known, ESP7000] if one["controller"].startswith(name)}


@contextmanager
def opened(dialogue: dict[str, Any]) -> Iterator[SerialStage]:
    """A stage in front of a controller that gives the answers of a dialogue, and none to any other word."""
    server = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        link, _ = server.accept()
        with link:
            held = b""
            while data := link.recv(1000):
                *words, held = (held + data).replace(b"\r\n", b"\r").replace(b"\n", b"\r").split(b"\r")
                for word in (word.decode() for word in words):
                    if word in dialogue["answers"]:
                        link.sendall(dialogue["answers"][word].encode() + b"\r\n")

    threading.Thread(target=answer, daemon=True).start()
    url = f"socket://127.0.0.1:{server.getsockname()[1]}"
    stage = STAGE_DRIVERS[dialogue["driver"]](url, {dialogue["axis"]: AxisOptions()})
    try:
        stage.open()
        yield stage
    finally:
        stage.close()
        server.close()


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_with_these_answers_opens_and_is_who_it_says_it_is(shared_dir: Path, name: str) -> None:
    dialogue = controllers(shared_dir)[name]
    with opened(dialogue) as stage:
        found, axis = stage.identify(), dialogue["axis"]
        expected = dialogue.get("identity", {})
        assert found.model == expected.get("model", found.model)
        assert found.firmware == expected.get("firmware", found.firmware)
        assert found.axes[0].model == expected.get("stage", found.axes[0].model)
        assert stage.state(axis).state.value == dialogue["state"]
        open_loop = dialogue["answers"].get(f"{axis}SC?") == f"{axis}SC0"
        assert ("SC0" in stage.state(axis).detail) is open_loop
        assert ("SC0" in [message.code for message in stage.errors()]) is open_loop
        assert stage.limits(axis).low_mm < stage.limits(axis).high_mm


def test_a_search_for_home_may_take_as_long_as_the_slow_axis_needs() -> None:
    assert longest_search_s((0.0, 25.0), 0.2) > 1.5 * 125.0  # a TRA25CC, over its whole travel
    assert longest_search_s((0.0, 12.0), 2.0) == 120.0
