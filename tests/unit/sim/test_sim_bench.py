"""Driver, simulated controller, world and cameras together: what the stage does is what the cameras see."""

from __future__ import annotations

import numpy as np

from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.drivers.registry import open_stage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.grabber import SimFrameGrabber
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.requirements import ROOT

CONFIG = ROOT / "config" / "sim_paper.toml"


def test_a_move_over_the_wire_changes_the_image_and_the_way_back_restores_it() -> None:
    controller = SimESP301(time_scale=50.0)
    world = SimWorld(SimRig.from_toml(CONFIG), controller.true_position_mm)
    with ControllerServer(controller) as server:
        stage = open_stage("esp301", server.url, {1: AxisOptions(backlash_mm=0.05), 2: AxisOptions()})
        cams = [SimFrameGrabber(world, name, latency_s=60.0) for name in ("cam1", "cam2")]
        for axis in stage.axes:
            stage.enable(axis)
            stage.home(axis)
        for cam in cams:
            cam.open()
            cam.configure(CameraSettings(trigger="software"))
            cam.arm()

        def capture() -> list[np.ndarray]:
            numbers = [cam.trigger() for cam in cams]
            frames = [cam.next_frame(120.0) for cam in cams]
            assert numbers[0] == numbers[1]
            assert all(frame is not None and frame.pixels.shape == (480, 512) for frame in frames)
            assert len({frame.device_ns for frame in frames if frame}) == 1
            return [frame.pixels.astype(float) for frame in frames if frame]

        stage.move_to(1, 0.0)
        before = capture()
        stage.move_to(1, 5.0)
        moved = capture()
        stage.move_to(1, 0.0)
        after = capture()
        for cam in cams:
            cam.close()
        stage.close()
    change = [[float(np.std(now - then)) for now, then in zip(x, before, strict=True)] for x in (moved, after)]
    noise = change[1][1]  # camera 2 never moved: what remains is the noise of two exposures
    assert change[0][1] < 1.1 * noise
    assert change[1][0] < 1.1 * noise
    assert change[0][0] > 3.0 * noise  # camera 1 came 5 mm closer to the grid
