"""The ESP301's words: examples printed in the ESP300/ESP301 manual (section 3), against controller and driver."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.stages.makers.esp301 import ESP301Stage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.controllers.wire import WireController


class Scripted(WireController):
    """Answers with literal replies; what it does not know it keeps silent about."""

    terminator = b"\r"

    def __init__(self, replies: dict[str, str | list[str]]) -> None:
        super().__init__()
        self.replies = replies

    def _execute(self, text: str) -> bytes:
        reply = self.replies.get(text)
        if isinstance(reply, list):
            reply = reply.pop(0) if len(reply) > 1 else reply[0]
        return b"" if reply is None else reply.encode("ascii") + b"\r\n"

    def axis(self, number: int) -> SimAxis:
        raise AssertionError(f"nobody asks a script where axis {number} is")


REPLIES: dict[str, str | list[str]] = {
    "VE?": "ESP300 Version 3.01 09/17/99",
    "1ID?": "TS50DC.5, SN1263",
    "1SN?": "2",
    "1SL?": "-25",
    "1SR?": "25.000",
    "1VA?": "10",
    "1AC?": "40",
    "1VU?": "20",
    "1AU?": "400",
    "TB?": "0, 451322, NO ERROR DETECTED",
    "1MD?": "1",
    "1MO?": "1",
    "1TP": "0.0000",
}


@pytest.fixture
def controller() -> SimESP301:
    return SimESP301(time_scale=100.0)


@pytest.fixture
def scripted() -> Iterator[tuple[Scripted, ControllerServer]]:
    fake = Scripted(dict(REPLIES))
    with ControllerServer(fake) as server:
        yield fake, server


def test_replies_end_in_carriage_return_and_line_feed(controller: SimESP301) -> None:
    assert re.fullmatch(rb"0, \d+, NO ERROR DETECTED\r\n", controller.take_line(b"TB?"))
    assert controller.take_line(b"TE?") == b"0\r\n"


def test_the_manuals_example_of_an_axis_that_is_not_there(controller: SimESP301) -> None:
    assert controller.take_line(b"8PA12.3") == b""
    assert controller.take_line(b"TE?") == b"9\r\n"
    assert controller.take_line(b"TE?") == b"0\r\n"


def test_blanks_and_small_letters_are_ignored(controller: SimESP301) -> None:
    for line in (b"2 PA 1000", b"2PA1000", b"2pa1000"):
        controller.take_line(line)
        assert controller.take_line(b"TE?") == b"213\r\n"  # motor not enabled: understood alike


def test_the_manuals_line_of_four_commands_runs_in_order(controller: SimESP301) -> None:
    assert controller.take_line(b"3MO; 3PA10.0; 3WS; 3MF") == b""
    assert controller.take_line(b"3TP") == b"10.0000\r\n"
    assert controller.take_line(b"3MO?") == b"0\r\n"
    assert controller.take_line(b"TE?") == b"0\r\n"


def test_relative_and_signed_targets_as_in_the_manual(controller: SimESP301) -> None:
    controller.take_line(b"1MO;2MO")
    controller.take_line(b"1PA+30; 1WS; 2PR-10; 2WS")
    assert controller.take_line(b"1TP;2TP") == b"30.0000\r\n-10.0000\r\n"


def test_a_command_without_its_axis_and_an_unknown_one_are_errors(controller: SimESP301) -> None:
    controller.take_line(b"PA10")
    controller.take_line(b"1QQ5")
    controller.take_line(b"1PAx")
    controller.take_line(b"1PA" + b"0" * 90)
    assert [controller.take_line(b"TE?") for _ in range(5)] == [b"37\r\n", b"6\r\n", b"7\r\n", b"6\r\n", b"0\r\n"]


def test_the_queue_keeps_ten_errors(controller: SimESP301) -> None:
    for _ in range(12):
        controller.take_line(b"9PA1")
    codes = [controller.take_line(b"TE?") for _ in range(12)]
    assert codes == [b"9\r\n"] * 10 + [b"0\r\n"] * 2


def test_abort_switches_all_motors_off(controller: SimESP301) -> None:
    controller.take_line(b"1MO;2MO;3MO")
    controller.take_line(b"AB")
    assert controller.take_line(b"1MO?;2MO?;3MO?") == b"0\r\n0\r\n0\r\n"


def test_the_driver_reads_the_manuals_replies(scripted: tuple[Scripted, ControllerServer]) -> None:
    fake, server = scripted
    stage = ESP301Stage(server.url, {1: AxisOptions(assume_homed=True)}, timeout_s=0.25)
    stage.open()
    identity = stage.identify()
    assert (identity.model, identity.firmware) == ("ESP300", "3.01")
    assert (identity.axes[0].model, identity.axes[0].serial) == ("TS50DC.5", "SN1263")
    assert (stage.limits(1).low_mm, stage.limits(1).high_mm) == (-25.0, 25.0)
    fake.replies["TB?"] = ["108, 451339, MOTOR NOT CONNECTED", "0, 451340, NO ERROR DETECTED"]
    messages = stage.errors()
    assert [(message.code, message.axis, message.text) for message in messages] == [("108", 1, "MOTOR NOT CONNECTED")]
    stage.close()


def test_the_drivers_bytes_for_a_move_are_these(scripted: tuple[Scripted, ControllerServer]) -> None:
    fake, server = scripted
    stage = ESP301Stage(server.url, {1: AxisOptions(assume_homed=True)}, timeout_s=0.25)
    stage.open()
    fake.received.clear()
    fake.replies["1TP"] = ["0.0000", "5.0000"]
    stage.move_to(1, 5)
    stage.close()
    sent = [entry.text for entry in fake.received]
    assert sent == [
        "1MD?",
        "1MO?",
        "1TP",  # ready?
        "1SN?",  # still in millimetres?
        "TB?",  # old errors out of the way
        "1PA5.000000",
        "TB?",  # accepted?
        "1MD?",
        "1MO?",
        "1TP",  # at rest?
        "TB?",  # without an error?
        "1TP",  # where?
    ]


def test_positions_in_micrometres_become_millimetres(scripted: tuple[Scripted, ControllerServer]) -> None:
    fake, server = scripted
    fake.replies |= {"1SN?": "3", "1SL?": "-25000", "1SR?": "25000", "1TP": ["1500.0", "1500.0", "2500.5"]}
    stage = ESP301Stage(server.url, {1: AxisOptions(assume_homed=True)}, timeout_s=0.25)
    stage.open()
    assert stage.limits(1).high_mm == pytest.approx(25.0)
    assert stage.position(1) == pytest.approx(1.5)
    assert stage.move_to(1, 2.5005).position_mm == pytest.approx(2.5005)
    assert fake.commands("PA") == ["1PA2500.500000"]
    stage.close()


@pytest.mark.parametrize("unit", ["0", "1", "7"])
def test_an_axis_that_does_not_count_lengths_is_refused(scripted: tuple[Scripted, ControllerServer], unit: str) -> None:
    fake, server = scripted
    fake.replies["1SN?"] = unit
    with pytest.raises(StageError, match="no length") as caught:
        ESP301Stage(server.url, {1: AxisOptions()}, timeout_s=0.25).open()
    assert caught.value.code == "unit_not_length"


def test_a_firmware_that_does_not_tell_its_greatest_velocity_is_taken(
    scripted: tuple[Scripted, ControllerServer],
) -> None:
    fake, server = scripted
    del fake.replies["1VU?"], fake.replies["1AU?"]
    stage = ESP301Stage(server.url, {1: AxisOptions(assume_homed=True)}, timeout_s=0.1)
    stage.open()
    assert stage.dynamics(1).max_velocity_mm_s is None
    assert stage.state(1).homed
    stage.close()


@pytest.mark.parametrize(
    ("unit", "factor", "name"), [(2, 1.0, "mm"), (3, 1e3, "um"), (4, 1 / 25.4, "in"), (5, 1e3 / 25.4, "milli-in")]
)
def test_every_unit_of_length_means_the_same_millimetres(unit: int, factor: float, name: str) -> None:
    controller = SimESP301(time_scale=100.0, travel_mm=(-20.0, 20.0))
    controller.take_line(f"1SN{unit}".encode())
    with ControllerServer(controller) as server:
        stage = ESP301Stage(server.url, {1: AxisOptions(velocity_mm_s=5.0, acceleration_mm_s2=20.0)}, timeout_s=0.25)
        stage.open()
        assert stage.identify().axes[0].units == name
        assert (stage.limits(1).low_mm, stage.limits(1).high_mm) == pytest.approx((-20.0, 20.0), abs=1e-3)
        assert controller.axis(1).velocity_mm_s == pytest.approx(5.0, rel=1e-4)
        assert stage.dynamics(1).max_velocity_mm_s == pytest.approx(40.0, rel=1e-4)
        stage.enable(1)
        stage.home(1)
        assert stage.move_to(1, 12.7).position_mm == pytest.approx(12.7, abs=1.5e-4)
        assert controller.true_position_mm(1) == pytest.approx(12.7, abs=1e-5)
        assert float(controller.take_line(b"1TP")) == pytest.approx(12.7 * factor, rel=1e-4)
        stage.close()


def test_units_changed_behind_our_back_stop_the_next_move_before_it_starts() -> None:
    controller = SimESP301(time_scale=100.0)
    with ControllerServer(controller) as server:
        stage = ESP301Stage(server.url, {1: AxisOptions()}, timeout_s=0.25)
        stage.open()
        stage.enable(1)
        stage.home(1)
        stage.move_to(1, 5.0)
        controller.take_line(b"1SN3")  # at the front panel: 5 would now mean 5 um
        before = len(controller.commands("PA"))
        with pytest.raises(StageError, match="counts in um") as caught:
            stage.move_to(1, 5.0)
        assert caught.value.code == "units_changed"
        assert len(controller.commands("PA")) == before
        controller.take_line(b"1SN2")
        stage.move_to(1, 6.0)
        stage.close()


def test_an_axis_homes_in_the_way_that_the_rig_file_names(scripted: tuple[Scripted, ControllerServer]) -> None:
    fake, server = scripted
    stage = ESP301Stage(server.url, {1: AxisOptions(home_mode=4)}, timeout_s=0.25)
    stage.open()
    stage.home(1)
    assert fake.commands("OR") == ["1OR4"]
    stage.close()


def test_another_device_on_the_line_is_no_esp301(scripted: tuple[Scripted, ControllerServer]) -> None:
    fake, server = scripted
    fake.replies["VE?"] = "SIGNAL GENERATOR 9000"
    with pytest.raises(StageError) as caught:
        ESP301Stage(server.url, {1: AxisOptions()}, timeout_s=0.1).open()
    assert caught.value.code == "stage_lost"


def test_a_lost_line_takes_the_reference_with_it() -> None:
    controller = SimESP301(time_scale=100.0)
    with ControllerServer(controller) as server:
        stage = ESP301Stage(server.url, {1: AxisOptions()}, timeout_s=0.1)
        stage.open()
        stage.enable(1)
        stage.home(1)
        assert stage.state(1).homed
        controller.line_faults.deaf = True
        with pytest.raises(StageError):
            stage.position(1)
        controller.line_faults.deaf = False
        # it may have been switched off and on meanwhile, and cannot say so
        assert not stage.state(1).homed
        with pytest.raises(StageError) as caught:
            stage.move_to(1, 1.0)
        assert caught.value.code == "not_homed"
        stage.close()


def test_a_simulated_controller_is_made_by_its_drivers_name() -> None:
    assert make_controller("esp301", (1, 3)).take_line(b"3TP") == b"0.0000\r\n"
    assert make_controller("smc100", (2, 7)).take_line(b"7TS") == b"7TS00000A\r\n"
    with pytest.raises(StageError) as caught:
        make_controller("xps", (1,))
    assert caught.value.code == "unknown_driver"
