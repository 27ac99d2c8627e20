"""Drivers that others wrote, driving our simulated controllers: independent witnesses of the wire protocols.

PyMeasure's ESP300 over pyvisa and pyvisa-py, on a socket and on a pty; hvl_ccb's NewportSMC100PP over pyserial on a
pty; newportxps on the XPS of our tests; Zaber's and PI's own libraries on the controllers of our
tests, and a library of Thorlabs' messages. Where one of them
disagrees with a simulator, the manual says who is right.
"""

from __future__ import annotations

import importlib
import logging
import re
import threading
import time
from collections.abc import Iterator
from types import ModuleType
from typing import Any, Literal

import pytest

from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.controllers.smc100 import SimSMC100
from tests.support.fake_kinesis import FakeKinesis
from tests.support.fake_pi import FakePI
from tests.support.fake_xps import FakeXPS
from tests.support.fake_zaber import FakeZaber
from tests.support.requirements import missing
from tests.support.stage_bench import Server

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

    from stereorig.sim.controllers.esp301 import _AXIS_TEXTS, _TEXTS

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
    from stereorig.sim.controllers.smc100 import _BITS, _TEXTS

    letters = newport.NewportSMC100PPSerialCommunication.ControllerErrors
    assert {error.value: error.message for error in letters} == _TEXTS
    # it counts bits from the left of three hexadecimal digits
    bits = {1 << (11 - error.value): error.message for error in newport.NewportSMC100PP.MotorErrors}
    assert bits[_BITS["following_error"]] == "Following error"
    assert bits[_BITS["positive_limit"]] == "Positive end of turn"
    assert bits[_BITS["negative_limit"]] == "Negative end of turn"


def test_the_drivers_states_and_bits_are_hvl_ccbs() -> None:
    newport = witness("hvl_ccb.dev.newport", "hvl_ccb")
    from stereorig.drivers.stages.makers.smc100 import _POSITIONER_ERRORS, _STATES
    from stereorig.drivers.stages.protocol import AxisState

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


# XPS driven by newportxps -----------------------------------------------------------------------------------------


def test_newportxps_homes_moves_and_aborts_on_the_xps_of_our_tests() -> None:
    controllers = witness("newportxps.XPS_C8_drivers", "newportxps")
    fake = FakeXPS(time_scale=20.0)
    xps = controllers.XPS()
    try:
        one, two = (xps.TCP_ConnectToServer("127.0.0.1", fake.port, 20) for _ in range(2))
        assert xps.FirmwareVersionGet(one)[1] == "XPS-D Firmware V1.4.1"
        assert xps.errorcodes["-22"] == "Not allowed action"
        assert xps.GroupHomeSearch(one, "Group1")[0] == -22  # it must be initialised first
        assert xps.GroupInitialize(one, "Group1")[0] == 0
        assert xps.GroupStatusGet(one, "Group1") == [0, 42]
        assert xps.GroupHomeSearch(one, "Group1")[0] == 0  # it answers when home is found
        assert xps.GroupStatusGet(one, "Group1") == [0, 11]
        assert xps.PositionerUserTravelLimitsGet(one, "Group1.Pos") == [0, -50.0, 50.0]
        assert xps.GroupMoveAbsolute(one, "Group1.Pos", [5.25])[0] == 0
        assert xps.GroupPositionCurrentGet(one, "Group1.Pos", 1) == [0, pytest.approx(5.25, abs=1e-4)]
        answers: list[int] = []
        move = threading.Thread(target=lambda: answers.append(xps.GroupMoveAbsolute(one, "Group1.Pos", [45.0])[0]))
        move.start()
        while xps.GroupStatusGet(two, "Group1")[1] != 44:
            time.sleep(0.001)
        assert xps.GroupMoveAbort(two, "Group1")[0] == 0
        move.join(5.0)
        assert answers == [-27]
        assert fake.axes["Group1"].true_position_mm() < 40.0
        assert xps.GroupMotionDisable(one, "Group1")[0] == 0
        assert xps.GroupKill(one, "Group1")[0] == 0
        for connection in (one, two):
            xps.TCP_CloseSocket(connection)
    finally:
        fake.close()


# Zaber devices driven by Zaber's own library ---------------------------------------------------------------------


@pytest.mark.parametrize("device", [{}, {"one_device": True}, {"firmware": "6.33"}], ids=str)
def test_zabers_library_homes_moves_stops_and_reads_what_the_fake_device_says(device: dict[str, Any]) -> None:
    zaber = witness("zaber_motion.ascii", "zaber-motion")
    errors = witness("zaber_motion", "zaber-motion")
    controller = FakeZaber(time_scale=50.0, start_mm=3.0, **device)
    with (
        ControllerServer(controller, "socket") as server,
        zaber.Connection.open_tcp("127.0.0.1", int(server.url.rpartition(":")[2])) as line,
    ):
        first, *others = line.detect_devices(identify_devices=False)
        assert len(others) == (0 if device.get("one_device") else 1)
        axis = first.get_axis(1)
        assert not axis.is_homed()
        axis.home()
        assert axis.is_homed()
        assert controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-9)
        axis.move_absolute(100_000)
        assert axis.get_position() == 100_000
        assert controller.true_position_mm(1) == pytest.approx(100_000 * FakeZaber.mm, abs=1e-9)
        axis.settings.set("maxspeed", 40_000)
        assert controller.axis(1).velocity_mm_s == pytest.approx(40_000 / 1.6384 * FakeZaber.mm)
        for refused in (lambda: axis.move_absolute(1e8), lambda: axis.settings.set("maxspeed", 4e9)):
            with pytest.raises(errors.exceptions.BadDataException):
                refused()
        axis.driver_disable()
        assert axis.warnings.get_flags() == {zaber.WarningFlags.DRIVER_DISABLED_NO_FAULT}
        axis.driver_enable()
        axis.move_absolute(1_000_000, wait_until_idle=False)
        axis.stop()
        assert not axis.is_busy()
        assert controller.true_position_mm(1) < 39.0
        axis.move_absolute(0)
        controller.axis(1).faults.jam_mm = (-5.0, 20.0)
        with pytest.raises(errors.exceptions.MovementFailedException, match="Stalled and Stopped"):
            axis.move_absolute(1_100_000)
        axis.warnings.clear_flags()
        assert axis.warnings.get_flags() == set()


def test_the_drivers_warnings_are_zabers() -> None:
    zaber = witness("zaber_motion.ascii", "zaber-motion")
    from stereorig.drivers.stages.makers.zaber import _MOTOR_OFF, _NO_REFERENCE, _TEXTS

    theirs = {value for name, value in vars(zaber.WarningFlags).items() if name.isupper()}
    assert {*_TEXTS, *_MOTOR_OFF, *_NO_REFERENCE} <= theirs
    flags = zaber.WarningFlags
    assert {flags.NO_REFERENCE_POSITION, flags.DEVICE_NOT_HOMED} == _NO_REFERENCE


# PI's controller driven by PI's own library ----------------------------------------------------------------------


def test_pipython_starts_references_moves_and_stops_the_fake_controller() -> None:
    pipython = witness("pipython", "pipython")
    gateway = witness("pipython.pidevice.interfaces.pisocket", "pipython").PISocket
    tools = witness("pipython.pitools", "pipython")
    del pipython.GCSDevice.__del__  # it closes again what is closed
    controller = FakePI(time_scale=50.0, start_mm=3.0)
    with Server(controller, "socket") as server:
        device = pipython.GCSDevice(gateway=gateway("127.0.0.1", int(server.url.rpartition(":")[2])))
        try:
            assert "C-884" in device.qIDN()
            assert device.axes == ["1", "2"]
            tools.startup(device, refmodes="FRF")
            assert dict(device.qFRF()) == {"1": True, "2": True}
            assert controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-9)
            assert (device.qTMN("1")["1"], device.qTMX("1")["1"], device.qPUN("1")["1"]) == (-50.0, 50.0, "MM")
            device.MOV("1", 5.25)
            tools.waitontarget(device, "1")
            assert device.qPOS("1")["1"] == pytest.approx(5.25, abs=1e-4)
            device.VEL("1", 2.5)
            assert controller.axis(1).velocity_mm_s == 2.5
            for refused, code in ((lambda: device.VEL("1", 1e4), 8), (lambda: device.MOV("1", 500), 7)):
                with pytest.raises(pipython.GCSError) as caught:
                    refused()
                assert caught.value.val == code
            for halt in (lambda: device.HLT("1", noraise=True), lambda: device.StopAll(noraise=True)):
                device.MOV("1", 40)
                assert device.IsMoving("1")["1"]
                halt()
                tools.waitonready(device)
                while device.IsMoving("1")["1"]:
                    pass
                assert controller.true_position_mm(1) < 39.0
            device.SVO("1", 0)
            with pytest.raises(pipython.GCSError) as caught:
                device.MOV("1", 0)
            assert caught.value.val == 5
        finally:
            device.close()


def test_the_drivers_error_codes_are_pis() -> None:
    codes = witness("pipython.pidevice.gcserror", "pipython")
    from stereorig.drivers.stages.makers.pi import _ERRORS, _STOPPED, _UNKNOWN_COMMAND

    assert (_STOPPED, _UNKNOWN_COMMAND) == (codes.E10_PI_CNTR_STOP, codes.E2_PI_CNTR_UNKNOWN_COMMAND)
    words = {"out_of_limits": "limits", "out_of_range": "range|limits", "not_homed": "unreferenced", "motor_off": "off"}
    for number, (_, code) in _ERRORS.items():
        theirs = codes.translate_error(number)
        assert f"{number}" in theirs or "Unknown" not in theirs
        assert code not in words or re.search(words[code], theirs.lower()), theirs


# Thorlabs' controller and thorlabs-apt-protocol ------------------------------------------------------------------


def test_the_messages_of_the_kinesis_driver_are_those_of_the_protocol_library() -> None:
    theirs = witness("thorlabs_apt_protocol", "thorlabs-apt-protocol")
    from stereorig.drivers.registry import make_stage
    from stereorig.drivers.stages.protocol import AxisOptions

    controller = FakeKinesis(time_scale=50.0, start_mm=3.0)
    options = {1: AxisOptions(soft_limits_mm=(-50.0, 50.0), mm_per_step=FakeKinesis.mm, velocity_mm_s=2.5)}
    with Server(controller, "socket") as server:
        stage = make_stage("kinesis", server.url, options)
        stage.open()
        stage.enable(1)
        stage.home(1)
        stage.move_to(1, -12.5)
        stage.stop()
        stage.abort()
        stage.close()
    there = (0x50, 0x01)
    speeds = theirs.mot_set_velparams(*there, 1, 0, 3054, 559241)  # 40 mm/s^2 and 2.5 mm/s in a KDC101's units
    known = {
        message.hex()
        for message in (
            theirs.hw_stop_updatemsgs(*there),
            theirs.hw_req_info(*there),
            theirs.mot_req_velparams(*there, 1),
            speeds,
            theirs.mot_req_dcstatusupdate(*there, 1),
            theirs.mod_set_chanenablestate(*there, 1, 1),
            theirs.mod_set_chanenablestate(*there, 1, 2),
            theirs.mot_move_home(*there, 1),
            theirs.mot_move_absolute(*there, 1, -125_000),
            theirs.mot_move_stop(*there, 1, 2),
            theirs.mot_move_stop(*there, 1, 1),
        )
    }
    assert {entry.text for entry in controller.received} == known


def test_the_protocol_library_reads_what_the_fake_kinesis_controller_answers() -> None:
    theirs = witness("thorlabs_apt_protocol", "thorlabs-apt-protocol")
    controller = FakeKinesis(time_scale=50.0, start_mm=3.0)
    there = (0x50, 0x01)

    def ask(message: bytes) -> dict[str, Any]:
        unpacker = theirs.Unpacker(on_error="raise")
        unpacker.feed(controller.take_line(message.hex().encode()))
        return {found.msg: found for found in unpacker}

    assert ask(theirs.hw_req_info(*there))["hw_get_info"].serial_number == 27000001
    ask(theirs.mod_set_chanenablestate(*there, 1, 1))
    ask(theirs.mot_move_home(*there, 1))
    state = ask(theirs.mot_req_dcstatusupdate(*there, 1))["mot_get_dcstatusupdate"]
    assert (state.homing, state.homed, state.channel_enabled) == (True, False, True)
    while controller.axis(1).moving:
        time.sleep(0.001)
    ended = ask(theirs.mot_req_dcstatusupdate(*there, 1))
    assert "mot_move_homed" in ended
    ask(theirs.mot_move_absolute(*there, 1, 400_000))
    state = ask(theirs.mot_req_dcstatusupdate(*there, 1))["mot_get_dcstatusupdate"]
    assert state.moving_forward
    while state.moving_forward and state.position == 0:  # a count takes it a moment
        state = ask(theirs.mot_req_dcstatusupdate(*there, 1))["mot_get_dcstatusupdate"]
    assert state.position > 0
    assert "mot_move_stopped" in ask(theirs.mot_move_stop(*there, 1, 2))
    speeds = ask(theirs.mot_req_velparams(*there, 1))["mot_get_velparams"]
    assert speeds.max_velocity == pytest.approx(10.0 / FakeKinesis.mm * 65536 * 2048 / 6e6, rel=1e-6)
