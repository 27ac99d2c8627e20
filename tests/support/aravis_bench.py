"""Two fake GigE cameras as a bench for the camera contract."""

from __future__ import annotations

import tempfile
from pathlib import Path

from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraOptions, FrameGrabber
from stereorig.drivers.registry import make_camera
from tests.support.camera_bench import CameraBench
from tests.support.fake_gige import FakeCamera, small_sensor_xml


class AravisBench(CameraBench):
    """Fake GigE cameras; see `fake_gige`.

    They never repeat a packet or a frame, and nothing makes them skip a frame number, so ``drop`` and ``duplicate``
    are not among what can be spoilt.
    """

    name = "aravis"
    region_px = (16, 8, 256, 128)

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="stereorig-gige-")
        xml = small_sensor_xml()
        self.cameras: dict[CameraName, FakeCamera] = {
            "cam1": FakeCamera("a", xml, Path(self._folder.name)),
            "cam2": FakeCamera("b", xml, Path(self._folder.name)),
        }
        self._made: list[FrameGrabber] = []
        self._how: dict[CameraName, str] = {}

    def make(self, cam: CameraName) -> FrameGrabber:
        options = CameraOptions(device=self.cameras[cam].device, trigger_source="Line0")
        self._made.append(make_camera("aravis", options))
        return self._made[-1]

    def lose(self, cam: CameraName, how: str) -> None:
        camera = self.cameras[cam]
        self._how[cam] = how
        {"killed": camera.kill, "stopped": camera.stop, "cable": camera.unplug}[how]()

    def bring_back(self, cam: CameraName) -> None:
        camera = self.cameras[cam]
        {"killed": camera.start, "stopped": camera.resume, "cable": camera.plug}[self._how.pop(cam)]()
        camera.await_answer()

    def spoil(self, cam: CameraName, what: str, grabber: FrameGrabber) -> None:
        if what == "incomplete":
            self.cameras[cam].narrow()
        else:  # it begins to count at 65400, so that it wraps by itself soon
            assert what == "wrap"

    def reset(self) -> None:
        for grabber in self._made:
            grabber.close()
        self._made.clear()
        self._how.clear()
        for camera in self.cameras.values():
            camera.plug()
            camera.widen()
            camera.kill()
            camera.start()

    def end(self) -> None:
        """Take everything away."""
        for camera in self.cameras.values():
            camera.end()
        self._folder.cleanup()
