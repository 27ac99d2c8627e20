"""Two cameras of pylon's own emulator as a bench for the camera contract."""

from __future__ import annotations

import importlib.util
import os

from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FrameGrabber
from stereorig.drivers.registry import make_camera
from tests.support.camera_bench import CameraBench

SERIALS: dict[CameraName, str] = {"cam1": "0815-0000", "cam2": "0815-0001"}
#: of the environment: number of cameras to emulate
EMULATED = "PYLON_CAMEMU"


def what_is_missing() -> str | None:
    """What this machine lacks for pylon's emulator, and how to get it."""
    return None if importlib.util.find_spec("pypylon") else "pypylon (pip install 'stereorig[pylon]')"


class PylonBench(CameraBench):
    """Emulated cameras.

    Nothing makes them lose, repeat or renumber a frame. What they can do is to damage frames, and to go as a camera
    does whose plug is pulled.
    """

    name = "pylon"
    region_px = (16, 8, 256, 128)
    first_region_px = (0, 0, 512, 512)  # of 4096 x 4096 px

    def __init__(self) -> None:
        self._before = os.environ.get(EMULATED)
        os.environ[EMULATED] = str(len(SERIALS))
        self._made: dict[CameraName, list[FrameGrabber]] = {"cam1": [], "cam2": []}

    def make(self, cam: CameraName) -> FrameGrabber:
        self._made[cam].append(make_camera("pylon", CameraOptions(device=SERIALS[cam])))
        return self._made[cam][-1]

    def lose(self, cam: CameraName, how: str) -> None:
        session = self._made[cam][-1]._session  # type: ignore[attr-defined]
        with session._device.asked() as camera:
            camera.FirePnPCallback.Execute()

    def bring_back(self, cam: CameraName) -> None:
        """An emulated camera that went can be opened at once."""

    def spoil(self, cam: CameraName, what: str, grabber: FrameGrabber) -> None:
        assert what == "incomplete"
        grabber.configure(CameraSettings(features={"ForceFailedBufferCount": 3, "ForceFailedBuffer": True}))

    def reset(self) -> None:
        for made in self._made.values():
            for grabber in made:
                grabber.close()
            made.clear()

    def end(self) -> None:
        """Take the emulated cameras away."""
        os.environ.pop(EMULATED)
        if self._before is not None:
            os.environ[EMULATED] = self._before
