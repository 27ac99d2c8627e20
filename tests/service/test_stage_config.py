"""What a rig file may say about the stage: axes that differ, other controllers, lines that are not their usual ones."""

from __future__ import annotations

import pytest

from core.errors import FileFormatError
from drivers.stages.protocol import AxisOptions
from drivers.stages.smc100 import ConexCCStage
from server.config.rig_file import RigConfig
from server.rig.build import _axis_options, first_settings, open_devices
from sim.controllers.registry import make_controller
from sim.controllers.server import ControllerServer
from tests.support.stage_service import rig


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
            assert isinstance(devices.stage, ConexCCStage)
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
