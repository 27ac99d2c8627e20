"""Two of the kernel's simulated webcams (vivid) for the camera contract; the second has the multi-planar interface.

What goes wrong with them is asked of vivid's own controls. They count frames from just below 2**32, so that every
test of the contract may meet the wrap.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FeatureValue, FrameGrabber
from stereorig.drivers.cameras.v4l2 import make
from stereorig.drivers.cameras.v4l2.controls import Controls
from stereorig.drivers.cameras.v4l2.device import V4l2Device
from tests.support.camera_bench import CameraBench

NODES: dict[CameraName, str] = {"cam1": "/dev/video0", "cam2": "/dev/video1"}

#: what the tests may have changed, as vivid has it when it is loaded
_CALM: dict[str, FeatureValue] = {
    "percentage_of_dropped_buffers": 0,
    "timestamp_source": 0,
    "wrap_timestamp": 0,
    "quantization": 0,
    "test_pattern": 0,
    "osd_text_mode": 0,
    "brightness": 128,
    "contrast": 128,
    "boolean": True,
    "menu": 3,
}


@contextmanager
def controls_of(node: str) -> Iterator[Controls]:
    """The controls of a device that another one may be streaming from."""
    device = V4l2Device(node).open()
    try:
        with device.use():
            yield Controls(device)
    finally:
        device.close()


def put(node: str, **values: FeatureValue) -> None:
    """Set controls of a device."""
    with controls_of(node) as controls:
        for name, value in values.items():
            controls.put(*controls.check(name, value))


class V4L2Bench(CameraBench):
    """Vivid's webcams 0 and 1, with small pictures, since a machine without KVM draws them slowly."""

    name = "v4l2"
    rate_hz = 15.0
    triggers = ("free",)

    def __init__(self) -> None:
        self._made: list[FrameGrabber] = []
        self.reset()

    def make(self, cam: CameraName) -> FrameGrabber:
        grabber = make(CameraOptions(device=NODES[cam], buffers=8))
        self._made.append(grabber)
        return grabber

    def lose(self, cam: CameraName, how: str) -> None:
        put(NODES[cam], **{"disconnect" if how == "unplugged" else "inject_fatal_streaming_error": True})

    def bring_back(self, cam: CameraName) -> None:
        """Vivid plugs itself in again when the last one has closed it."""

    def spoil(self, cam: CameraName, what: str, grabber: FrameGrabber) -> None:
        if what == "drop":
            put(NODES[cam], percentage_of_dropped_buffers=30)
        elif what == "incomplete":
            put(NODES[cam], inject_v4l2_buf_flag_error=True)
        # the counters of all tests begin just before their wrap

    def reset(self) -> None:
        for grabber in self._made:
            grabber.close()
        self._made.clear()
        for node in NODES.values():
            calm(node)
            put(node, wrap_sequence_number=True)


def calm(node: str) -> None:
    """Bring a webcam to what it was at first, with small gray pictures."""
    put(node, wrap_sequence_number=False, **_CALM)
    grabber = make(CameraOptions(device=node))
    grabber.open()
    try:
        grabber.configure(CameraSettings(pixel_format="GREY", region_px=(0, 0, 320, 180), frame_rate_hz=15.0))
    finally:
        grabber.close()
