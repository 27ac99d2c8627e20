"""The SMC100's words: states, letters and traps as in its manual, against controller and driver."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.stages.makers.smc100 import SMC100Stage
from stereorig.drivers.stages.protocol import AxisOptions, AxisState
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.controllers.smc100 import SimSMC100
from tests.support.patience import Deadline


@pytest.fixture
def chain() -> SimSMC100:
    return SimSMC100(addresses=(1, 2), time_scale=100.0)


@pytest.fixture
def stage(chain: SimSMC100) -> Iterator[SMC100Stage]:
    with ControllerServer(chain) as server:
        made = SMC100Stage(server.url, {1: AxisOptions(), 2: AxisOptions()}, timeout_s=0.25)
        made.open()
        yield made
        made.close()


def rest(chain: SimSMC100, state: bytes) -> None:
    deadline = Deadline(5.0)
    while chain.take_line(b"1TS") != b"1TS0000" + state + b"\r\n":
        assert deadline.left
        time.sleep(0.002)


def test_the_states_of_a_life_are_the_manuals(chain: SimSMC100) -> None:
    assert chain.take_line(b"1TS") == b"1TS00000A\r\n"  # not referenced, from reset
    assert chain.take_line(b"1OR") == b""
    rest(chain, b"32")  # ready, from homing
    chain.axis(1).velocity_mm_s = 0.5
    chain.take_line(b"1PA5.0")
    assert chain.take_line(b"1TS") == b"1TS000028\r\n"  # moving
    chain.take_line(b"ST")
    rest(chain, b"33")  # ready, from moving
    chain.take_line(b"1MM0")
    assert chain.take_line(b"1TS") == b"1TS00003C\r\n"  # disabled, from ready
    chain.take_line(b"1MM1")
    assert chain.take_line(b"1TS") == b"1TS000034\r\n"  # ready, from disabled
    assert chain.take_line(b"2TS") == b"2TS00000A\r\n"


def test_error_letters_and_their_texts_are_the_manuals(chain: SimSMC100) -> None:
    for line, letter in ((b"1PA5", b"H"), (b"1XX", b"A"), (b"1VA?", b"@"), (b"1MM7", b"C"), (b"1PW0", b"H")):
        chain.take_line(line)
        assert chain.take_line(b"1TE") == b"1TE" + letter + b"\r\n"
        assert chain.take_line(b"1TE") == b"1TE@\r\n"  # read once, gone
    assert chain.take_line(b"1TBH") == b"1TBH Command not allowed in NOT REFERENCED state.\r\n"
    assert chain.take_line(b"1TB@") == b"1TB@ No error.\r\n"
    chain.take_line(b"1OR")
    rest(chain, b"32")
    for line, letter in ((b"1PA60", b"G"), (b"1OR", b"K")):
        chain.take_line(line)
        assert chain.take_line(b"1TE") == b"1TE" + letter + b"\r\n"


def test_what_follows_a_first_command_on_a_line_is_dropped(chain: SimSMC100) -> None:
    assert chain.take_line(b"1TP;1TS") == b"1TP0.0000\r\n"
    assert chain.take_line(b"1TP1TS") == b"1TP0.0000\r\n"


def test_a_foreign_address_is_met_with_silence(chain: SimSMC100) -> None:
    assert chain.take_line(b"9TS") == b""


def test_the_configuration_trap_is_named_and_left_on_request_only(chain: SimSMC100, stage: SMC100Stage) -> None:
    chain.take_line(b"1PW1")
    assert chain.take_line(b"1TS") == b"1TS000014\r\n"
    status = stage.state(1)
    assert status.state is AxisState.CONFIGURATION
    assert "PW0" in status.detail
    for call in (
        lambda: stage.home(1),
        lambda: stage.move_to(1, 1.0),
        lambda: stage.set_dynamics(1, velocity_mm_s=1.0),
    ):
        with pytest.raises(StageError, match="CONFIGURATION") as caught:
            call()
        assert caught.value.code == "configuration_state"
        assert "flash" in caught.value.remedy
    assert not chain.commands("PW0")
    assert chain.flash_writes(1) == 0
    stage.leave_configuration(1)
    assert chain.flash_writes(1) == 1
    assert stage.state(1).state is AxisState.NOT_HOMED
    assert stage.home(1) == pytest.approx(0.0)
    # asked for once more, there is nothing to leave: the flash is spared
    with pytest.raises(StageError) as caught:
        stage.leave_configuration(1)
    assert caught.value.code == "not_in_configuration"
    assert chain.commands("PW0") == ["1PW0"]


@pytest.mark.parametrize(
    ("number", "words"), [("36", "TK0"), ("37", "TK0"), ("46", "keypad"), ("47", "keypad"), ("7F", "unknown state 7F")]
)
def test_states_in_which_others_move_the_axis_are_faults_in_words(
    chain: SimSMC100, stage: SMC100Stage, number: str, words: str
) -> None:
    stage.home(1)
    chain.line_faults.stray = f"1TS0000{number}\r\n".encode()
    status = stage.state(1)
    assert status.state is AxisState.FAULT
    assert words in status.detail


def test_a_velocity_before_homing_is_refused_in_the_controllers_sense(chain: SimSMC100, stage: SMC100Stage) -> None:
    with pytest.raises(StageError) as caught:
        stage.set_dynamics(1, velocity_mm_s=1.0)
    assert caught.value.code == "not_homed"
    assert not [line for line in chain.commands("VA") if line != "1VA?" and line != "2VA?"]


def test_cut_motor_power_is_seen_behind_its_nul_byte(chain: SimSMC100, stage: SMC100Stage) -> None:
    stage.home(1)
    stage.move_to(1, 5.0)
    chain.cut_power()
    assert stage.state(1).state is AxisState.NOT_HOMED
    with pytest.raises(StageError) as caught:
        stage.move_to(1, 1.0)
    assert caught.value.code == "not_homed"


def test_homing_a_referenced_axis_moves_it_to_zero(chain: SimSMC100, stage: SMC100Stage) -> None:
    stage.home(1)
    stage.move_to(1, 5.0)
    assert stage.home(1) == pytest.approx(0.0, abs=1e-4)
    assert chain.commands("1OR") == ["1OR"]


def test_fault_bits_that_stay_are_reported_once(chain: SimSMC100, stage: SMC100Stage) -> None:
    stage.home(1)
    chain.axis(1).faults.jam_mm = (-5.0, 2.0)
    with pytest.raises(StageError, match="following error") as caught:
        stage.move_to(1, 5.0)
    assert caught.value.code == "motion_fault"
    chain.axis(1).faults.jam_mm = None
    assert [message.text for message in stage.errors()] == ["following error"]
    assert stage.errors() == ()
    stage.enable(1)
    assert stage.move_to(1, 5.0).position_mm == pytest.approx(5.0, abs=1e-4)


def test_an_echo_of_another_axis_is_no_answer(chain: SimSMC100, stage: SMC100Stage) -> None:
    chain.line_faults.stray = b"2TP33.0000\r\n1TS000033\r\n"
    assert stage.position(1) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("noise", [b"1TPnan\r\n", b"1TPinf\r\n", b"1TP\r\n", b"1TP1e\r\n", b"1TP5.0 \x7f\r\n"])
def test_a_position_that_is_no_number_is_no_answer(chain: SimSMC100, stage: SMC100Stage, noise: bytes) -> None:
    chain.line_faults.stray = noise
    assert stage.position(1) == pytest.approx(0.0, abs=1e-4)
