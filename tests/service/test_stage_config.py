"""What a rig file may say about the stage: axes that differ, other controllers, lines that are not their usual ones."""

from __future__ import annotations

import pytest

from stereorig.core.errors import FileFormatError
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.server.config.rig_file import RigConfig, load_config, parse_config
from stereorig.server.rig.build import _axis_options, first_settings, open_configured_stage, open_devices
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.support.fake_xps import FakeXPS
from tests.support.fake_zaber import FakeZaber
from tests.support.requirements import ROOT
from tests.support.stage_service import rig, rig_text


def refusal(more: str = "", **stage: str) -> str:
    with pytest.raises(FileFormatError) as caught:
        rig(more, **stage)
    assert caught.value.code == "config_invalid"
    return str(caught.value)


def options(config: RigConfig, axis: int) -> AxisOptions:
    return _axis_options(config, axis, (None, None))


def test_axes_that_differ_have_their_own_table() -> None:
    config = rig(
        """
[stage.axes.2]
velocity_mm_s = 2.5
soft_limits_mm = [-3.0, 4.0]
approach_from = "above"
backlash_mm = 0.2
zero_mm = 1.5
assume_homed = true
home_mode = 4
"""
    )
    one, two = options(config, 1), options(config, 2)
    assert one == options(rig(), 1)
    assert (two.velocity_mm_s, two.soft_limits_mm, two.approach_from) == (2.5, (-3.0, 4.0), "above")
    assert (two.backlash_mm, two.assume_homed, two.home_mode) == (0.2, True, 4)
    assert two.tolerance_mm == one.tolerance_mm  # what is left out is as in [stage]
    assert (config.stage.of_axis(1).zero_mm, config.stage.of_axis(2).zero_mm) == (0.0, 1.5)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("[stage.axes.3]\nvelocity_mm_s = 1.0", "cameras' axes are [1, 2]"),
        ("[stage.axes.0]\nvelocity_mm_s = 1.0", "stage.axes"),
        ("[stage.axes.x]\nvelocity_mm_s = 1.0", "stage.axes"),
        ("[stage.axes.1]\nspeed = 1.0", "stage.axes.1.speed"),
        ("[stage.axes.1]\nsoft_limits_mm = [4.0, -4.0]", "low < high"),
        ("[stage.axes.1]\nvelocity_mm_s = 0.0", "stage.axes.1.velocity_mm_s"),
        ("[stage.axes.1]\nhome_mode = 7", "stage.axes.1.home_mode"),
        ('[stage.axes.1]\npositioner = "A.Pos)GroupKill(B"', "stage.axes.1.positioner"),
    ],
)
def test_a_wrong_axis_table_is_named(more: str, words: str) -> None:
    assert words in refusal(more + "\n")


def test_simulated_cameras_can_look_at_a_real_stage_which_is_not_homed_unasked() -> None:
    controller = make_controller("conex-cc", (1, 2), time_scale=50.0, start_mm=3.0)
    with ControllerServer(controller) as server:
        config = rig(driver='"conex-cc"', url=f'"{server.url}"', reply_timeout_ms="250")
        assert config.home_at_start is False
        devices = open_devices(config, {cam: first_settings(config, cam) for cam in ("cam1", "cam2")})  # type: ignore[misc]
        try:
            assert devices.stage.identify().driver == "conex-cc"
            assert devices.stage.identify().model == "CONEX-CC"
            assert devices.controller is None
            assert not controller.commands("OR")
            devices.stage.home(1)
            devices.stage.move_to(1, 2.0)
            assert devices.world is not None
            # the pictures follow the stage: at 2 mm the camera is where the true rig would be
            assert devices.world._position_mm(1) == pytest.approx(2.0, abs=1e-4)
        finally:
            devices.close()


def test_a_standa_controller_has_one_axis_with_steps_of_known_length() -> None:
    controllers = "\n".join(f'[[stage.controllers]]\nurl = "xi-com:///dev/ttyACM{n}"\naxes = [{n}]' for n in (1, 2))
    text = rig_text(controllers, driver='"standa"')
    text = "\n".join(line for line in text.splitlines() if not line.startswith('url = "sim"'))
    with pytest.raises(FileFormatError, match="mm_per_step must be given"):
        parse_config(text)
    config = parse_config(text.replace('driver = "standa"', 'driver = "standa"\nmm_per_step = 0.00125'))
    assert options(config, 2).mm_per_step == 0.00125
    for driver in ("standa", "kinesis"):
        assert "one axis" in refusal(driver=f'"{driver}"', url='"xi-com:///dev/ttyACM0"', mm_per_step="0.00125")


def test_a_zaber_axis_is_named_by_device_and_axis_with_the_length_of_a_microstep() -> None:
    there = {"driver": '"zaber"', "url": '"socket://127.0.0.1:55550"'}
    assert "mm_per_step must be given for the axes [1, 2]" in refusal(**there)
    there["mm_per_step"] = "4.096e-5"
    for wrong in ("Left.Pos", "1.1", "100.1", "0.1"):
        assert "a Zaber axis is device.axis" in refusal(f'[stage.axes.2]\npositioner = "{wrong}"\n', **there)
    controller = FakeZaber(one_device=True, time_scale=50.0, start_mm=3.0)
    with ControllerServer(controller) as server:
        config = rig('[stage.axes.2]\npositioner = "1.2"\n', **(there | {"url": f'"{server.url}"'}))
        stage = open_configured_stage(config)
        try:
            stage.home(2)
            assert stage.move_to(2, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)
            assert controller.true_position_mm(1) == 3.0
        finally:
            stage.close()


def test_an_xps_has_its_axes_by_the_names_of_the_rig_file() -> None:
    assert "no simulated xps" in refusal(driver='"xps"')
    there = {"driver": '"xps"', "url": '"socket://127.0.0.1:1"'}
    assert "a group of its own" in refusal('[stage.axes.2]\npositioner = "Group1.X"\n', **there)
    fake = FakeXPS()
    fake.axes["Right"] = fake.axes.pop("Group2")
    fake.states["Right"] = fake.states.pop("Group2")
    try:
        config = rig('[stage.axes.2]\npositioner = "Right.Pos"\n', **(there | {"url": f'"{fake.url}"'}))
        stage = open_configured_stage(config)
        try:
            stage.enable(2)
            assert stage.home(2) == pytest.approx(0.0, abs=1e-4)
            assert [axis.serial for axis in stage.identify().axes] == ["Group1.Pos", "Right.Pos"]
        finally:
            stage.close()
    finally:
        fake.close()


@pytest.mark.parametrize(
    ("driver", "baud", "flow"),
    [("esp301", 921600, "hardware"), ("smc100", 57600, "software"), ("conex-cc", 921600, "software")],
)
def test_each_controller_has_its_usual_line_and_the_rig_file_another(
    driver: str, baud: int, flow: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import serial

    opened: list[dict[str, object]] = []

    def port(url: str, **settings: object) -> object:
        opened.append({"url": url, **settings})
        raise serial.SerialException("no port here")

    monkeypatch.setattr(serial, "serial_for_url", port)
    for more, expected in (({}, (baud, flow)), ({"baudrate": "19200", "flow_control": '"none"'}, (19200, "none"))):
        config = rig(driver=f'"{driver}"', url='"/dev/ttyS7"', **more)
        with pytest.raises(Exception, match="no port here"):
            open_devices(config, {cam: first_settings(config, cam) for cam in ("cam1", "cam2")})  # type: ignore[misc]
        last = opened[-1]
        found = "hardware" if last["rtscts"] else "software" if last["xonxoff"] else "none"
        assert (last["baudrate"], found) == expected
        assert (last["url"], last["exclusive"]) == ("/dev/ttyS7", True)


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "config").glob("lab_*.toml")))
def test_the_stage_of_a_laboratorys_rig_file_opens_on_the_controller_that_it_names(name: str) -> None:
    config = load_config(ROOT / "config" / name)
    assert config.stage is not None
    (line,) = config.stage.lines(config.axes)
    controller = make_controller(line.driver, sorted(line.numbers.values()), travel_mm=(-25.0, 25.0), time_scale=100.0)
    with ControllerServer(controller) as server:
        own = config.model_copy(update={"stage": config.stage.model_copy(update={"url": server.url})})
        stage = open_configured_stage(own)
        try:
            who = stage.identify()
            assert (who.driver, [one.axis for one in who.axes]) == (line.driver, list(config.axes))
            for axis in config.axes:
                section, limits = config.axis(axis), stage.limits(axis)
                assert (limits.low_mm, limits.high_mm) == section.soft_limits_mm
                stage.enable(axis)
                stage.home(axis)  # before it an SMC100 takes no speed
                assert stage.dynamics(axis).velocity_mm_s == pytest.approx(section.velocity_mm_s)
        finally:
            stage.close()
