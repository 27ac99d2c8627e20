"""Drivers that others wrote, driving our simulated controllers: independent witnesses of the wire protocols.

PyMeasure's ESP300 over pyvisa and pyvisa-py, on a socket and on a pty; hvl_ccb's NewportSMC100PP over pyserial on a
pty. Where one of them disagrees with a simulator, the manual says who is right.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator
from types import ModuleType
from typing import Any, Literal

import pytest

from sim.controllers.esp301 import SimESP301
from sim.controllers.server import ControllerServer
from sim.controllers.smc100 import SimSMC100
from tests.support.requirements import missing

# PyMeasure's own words about its driver
pytestmark = pytest.mark.filterwarnings("ignore:It is not known whether this device support SCPI:FutureWarning")


def witness(module: str, package: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError:
        missing(f"the package {package} (pip install {package})")
    raise AssertionError


# ESP301 driven by PyMeasure --------------------------------------------------------------------------------------


@pytest.fixture(params=["socket", "pty"])
def esp(request: pytest.FixtureRequest) -> Iterator[tuple[Any, SimESP301]]:
    newport = witness("pymeasure.instruments.newport", "pymeasure")
    witness("pyvisa_py", "pyvisa-py")
    transport: Literal["socket", "pty"] = request.param
    controller = SimESP301(time_scale=50.0, start_mm=3.0, travel_mm=(-25.0, 25.0))
    with ControllerServer(controller, transport) as server:
        if transport == "socket":
            resource = f"TCPIP::127.0.0.1::{server.url.rpartition(':')[2]}::SOCKET"
        else:
            resource = f"ASRL{server.url}::INSTR"
        instrument = newport.ESP300(
            resource, visa_library="@py", read_termination="\r\n", write_termination="\r", timeout=2000
        )
        try:
            yield instrument, controller
        finally:
            instrument.adapter.close()
            instrument.adapter.manager.close()


def test_pymeasure_identifies_the_controller(esp: tuple[Any, SimESP301]) -> None:
    instrument, _ = esp
    assert instrument.ask("VE?").strip().startswith("ESP301 Version ")
    assert [instrument.ask(f"{axis}ID?").partition(",")[0] for axis in (1, 2, 3)] == ["SIM-LTA-HS"] * 3


def test_pymeasure_enables_homes_and_moves(esp: tuple[Any, SimESP301]) -> None:
    instrument, controller = esp
    axis = instrument.x
    assert axis.enabled is False
    axis.enable()
    assert axis.enabled is True
    axis.home(1)
    axis.wait_for_stop()
    assert controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-9)
    assert axis.position == pytest.approx(0.0, abs=1e-4)
    axis.position = 5.25
    axis.wait_for_stop(delay=0.05)
    assert axis.motion_done is True
    assert axis.position == pytest.approx(5.25, abs=1e-4)
    assert controller.true_position_mm(1) == pytest.approx(5.25, abs=1e-6)
    axis.write("PR-1.25")
    axis.wait_for_stop()
    assert controller.true_position_mm(1) == pytest.approx(4.0, abs=1e-6)
    assert instrument.y.position == pytest.approx(0.0, abs=1e-4)
    assert instrument.error == 0
    axis.define_position(1.0)
    assert axis.position == pytest.approx(1.0, abs=1e-4)
    axis.zero()
    assert axis.position == pytest.approx(0.0, abs=1e-4)
    axis.disable()
    assert axis.enabled is False


def test_pymeasure_stops_a_move_and_aborts(esp: tuple[Any, SimESP301]) -> None:
    instrument, controller = esp
    axis = instrument.x
    axis.enable()
    axis.write("VA0.5")
    axis.position = 20.0
    assert axis.motion_done is False
    axis.write("ST")
    axis.wait_for_stop()
    assert controller.true_position_mm(1) < 19.0
    assert axis.enabled is True
    axis.position = 20.0
    instrument.write("AB")
    assert axis.motion_done is True
    assert axis.enabled is False
    assert controller.true_position_mm(1) < 19.0


def test_pymeasure_reads_limits_and_changes_them(esp: tuple[Any, SimESP301]) -> None:
    instrument, _ = esp
    axis = instrument.y
    assert (axis.left_limit, axis.right_limit) == (-25.0, 25.0)
    axis.right_limit = 4.5
    assert axis.right_limit == 4.5
    axis.enable()
    axis.position = 5.0
    assert [str(error) for error in instrument.errors] == [
        "Newport ESP300 axis 2 reported the error: POSITIVE SOFTWARE LIMIT DETECTED"
    ]
    assert axis.motion_done is True


def test_pymeasure_reads_errors_in_the_manuals_words(esp: tuple[Any, SimESP301]) -> None:
    instrument, controller = esp
    instrument.write("1QQ")  # no such command
    instrument.write("9MO")  # no such axis
    instrument.write("MO")  # whose axis?
    instrument.x.position = 1.0  # motor off
    instrument.x.enable()
    instrument.x.write("VA1000")
    instrument.x.write("AC100000")
    controller.axis(1).faults.jam_mm = (2.5, 3.5)
    instrument.x.position = 6.0
    instrument.x.wait_for_stop()
    assert [error.message for error in instrument.errors] == [
        "COMMAND DOES NOT EXIST",
        "AXIS NUMBER OUT OF RANGE",
        "AXIS NUMBER MISSING",
        "MOTOR NOT ENABLED",
        "MAXIMUM VELOCITY EXCEEDED",
        "MAXIMUM ACCELERATION EXCEEDED",
        "FOLLOWING ERROR THRESHOLD EXCEEDED",
    ]
    assert instrument.error == 0


def test_every_error_text_of_the_simulator_is_pymeasures(esp: tuple[Any, SimESP301]) -> None:
    from pymeasure.instruments.newport.esp300 import AxisError, GeneralError

    from sim.controllers.esp301 import _AXIS_TEXTS, _TEXTS

    slips = {"EMERGENCY SOP ACTIVATED": "EMERGENCY STOP ACTIVATED"}  # the witness' spelling, the manual's
    for code, text in _TEXTS.items():
        if code:
            ours = GeneralError(code).message
            assert slips.get(ours, ours) == text
    for code, text in _AXIS_TEXTS.items():
        assert AxisError(f"1{code:02d}").message == text


def test_pymeasures_units_are_the_simulators(esp: tuple[Any, SimESP301]) -> None:
    instrument, controller = esp
    axis = instrument.phi
    assert axis.units == "millimeter"
    axis.enable()
    axis.home()
    axis.wait_for_stop()
    axis.units = "micrometer"
    assert axis.units == "micrometer"
    assert axis.right_limit == 25000.0
    axis.position = 1500.0
    axis.wait_for_stop()
    assert axis.position == pytest.approx(1500.0, abs=0.1)
    assert controller.true_position_mm(3) == pytest.approx(1.5, abs=1e-6)
    axis.units = "inches"
    assert axis.position == pytest.approx(1.5 / 25.4, abs=1e-6)
    axis.units = "encoder count"
    assert axis.position == 15000.0


# SMC100 driven by hvl_ccb ----------------------------------------------------------------------------------------


@pytest.fixture
def smc() -> Iterator[tuple[SimSMC100, str]]:
    controller = SimSMC100(addresses=(1, 2), time_scale=50.0, start_mm=3.0, model="SMC100PP")
    with ControllerServer(controller, "pty") as server:
        yield controller, server.url


def hvl(url: str, **config: Any) -> Any:
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    com = newport.NewportSMC100PPSerialCommunication({"port": url, "timeout": 1})
    return newport.NewportSMC100PP(
        com,
        {
            "user_position_offset": 0,
            "exit_configuration_wait_sec": 0.05,
            "move_wait_sec": 0.01,
            "home_search_polling_interval": 0.02,
            **config,
        },
    )


def rest(device: Any) -> None:
    for _ in range(200):
        if device.get_state().state is not device.States.MOVING:
            return
    raise AssertionError("it moves on and on")


def test_hvl_ccb_configures_homes_and_moves(smc: tuple[SimSMC100, str]) -> None:
    controller, url = smc
    device = hvl(url)
    # the configuration differs from what it wants: it enters CONFIGURATION, sets every parameter, leaves
    device.start()
    try:
        assert controller.flash_writes(1) == 1
        assert device.get_motor_configuration() == device.config.motor_config
        assert device.get_controller_information().startswith("SMC100PP")
        assert device.get_state() is device.StateMessages.READY_FROM_HOMING
        assert device.get_position() == pytest.approx(0.0, abs=1e-4)
        assert (device.get_negative_software_limit(), device.get_positive_software_limit()) == (-23.5, 25.0)
        assert device.get_acceleration() == 10.0
        device.set_acceleration(5)
        assert device.get_acceleration() == 5.0
        device.move_to_absolute_position(5.25)
        rest(device)
        assert device.get_position() == pytest.approx(5.25, abs=1e-4)
        assert controller.true_position_mm(1) == pytest.approx(5.25, abs=1e-6)
        device.move_to_relative_position(-1.25)
        rest(device)
        assert controller.true_position_mm(1) == pytest.approx(4.0, abs=1e-6)
        # 8 mm at 4 mm/s and 5 mm/s^2, from rest to rest
        assert device.get_move_duration(8) == pytest.approx(8 / 4 + 4 / 5, abs=1e-3)
        device.go_home()
        rest(device)
        assert controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-6)
        assert controller.true_position_mm(2) == pytest.approx(3.0)  # no command was sent to its neighbour
    finally:
        device.stop()


def test_hvl_ccb_finds_the_configuration_that_it_wants_and_spares_the_flash(smc: tuple[SimSMC100, str]) -> None:
    controller, url = smc
    for _ in range(2):
        device = hvl(url)
        device.start()
        device.stop()
    assert controller.flash_writes(1) == 1


def test_hvl_ccb_stops_one_and_all(smc: tuple[SimSMC100, str]) -> None:
    controller, url = smc
    device = hvl(url)
    device.start()
    try:
        for add in (1, None):
            controller.axis(1).velocity_mm_s = 0.2
            device.move_to_absolute_position(20)
            assert device.get_state() is device.StateMessages.MOVING
            device.stop_motion(add)
            controller.axis(1).acceleration_mm_s2 = 400.0
            rest(device)
            assert device.get_state() is device.StateMessages.READY_FROM_MOVING
            assert controller.true_position_mm(1) < 19.0
    finally:
        device.stop()


def test_hvl_ccb_reads_refusals_and_faults_in_the_manuals_words(smc: tuple[SimSMC100, str]) -> None:
    controller, url = smc
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    device = hvl(url)
    device.start()
    logging.getLogger("hvl_ccb").setLevel(logging.CRITICAL)
    try:
        with pytest.raises(newport.NewportControllerError, match="Displacement out of limits"):
            device.move_to_absolute_position(30)
        with pytest.raises(newport.NewportControllerError, match="not allowed in READY state"):
            device.initialize()
        with pytest.raises(newport.NewportControllerError, match="Parameter missing or out of range"):
            device.set_acceleration(1e6)
        with pytest.raises(newport.NewportControllerError, match="Unknown message code"):
            device.com.send_command(1, "QQ")
        controller.axis(1).faults.jam_mm = (-1.0, 1.0)
        device.com.send_command(1, "PA", 5)
        with pytest.raises(newport.NewportMotorError, match="Following error"):
            rest(device)
    finally:
        logging.getLogger("hvl_ccb").setLevel(logging.NOTSET)
        device.stop()


def test_hvl_ccb_is_told_when_motor_power_was_cut(smc: tuple[SimSMC100, str]) -> None:
    controller, url = smc
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    device = hvl(url)
    device.start()
    try:
        device.move_to_absolute_position(2)
        rest(device)
        controller.cut_power()
        # it meets the NUL byte, asks once more, and finds the reference gone
        assert device.get_state() is device.StateMessages.NO_REF_FROM_RESET
        with pytest.raises(newport.NewportControllerError, match="NOT REFERENCED"):
            device.com.send_command(1, "PA", 1)
    finally:
        device.stop()


def test_every_letter_and_bit_of_the_simulator_is_hvl_ccbs() -> None:
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    from sim.controllers.smc100 import _BITS, _TEXTS

    letters = newport.NewportSMC100PPSerialCommunication.ControllerErrors
    assert {error.value: error.message for error in letters} == _TEXTS
    # it counts bits from the left of three hexadecimal digits
    bits = {1 << (11 - error.value): error.message for error in newport.NewportSMC100PP.MotorErrors}
    assert bits[_BITS["following_error"]] == "Following error"
    assert bits[_BITS["positive_limit"]] == "Positive end of turn"
    assert bits[_BITS["negative_limit"]] == "Negative end of turn"


def test_the_drivers_states_and_bits_are_hvl_ccbs() -> None:
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    from drivers.stages.protocol import AxisState
    from drivers.stages.smc100 import _POSITIONER_ERRORS, _STATES

    ours = {
        "NO_REF": AxisState.NOT_HOMED,
        "HOMING": AxisState.HOMING,
        "CONFIG": AxisState.CONFIGURATION,
        "READY": AxisState.READY,
        "MOVING": AxisState.MOVING,
        "DISABLE": AxisState.MOTOR_OFF,
    }
    for message in newport.NewportSMC100PP.StateMessages:
        if message.state.name != "JOGGING":
            assert _STATES[int(message.value, 16)] is ours[message.state.name]
        else:
            assert int(message.value, 16) not in _STATES
    for error in newport.NewportSMC100PP.MotorErrors:
        text = error.message.lower().replace("end of turn", "end of run").replace("timeout", "time out")
        text = text.removesuffix(" detection").replace("80w", "80 w")
        assert _POSITIONER_ERRORS[11 - error.value].lower() == text
