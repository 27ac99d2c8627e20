"""V4L2 cameras by the kernel's own interface: ioctl, mmap and poll, no library between."""

from __future__ import annotations

import platform

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraOptions, FoundDevice, FrameGrabber


def make(options: CameraOptions) -> FrameGrabber:
    """Make a camera, not yet opened; code ``driver_missing`` on systems other than Linux."""
    _require_linux()
    from stereorig.drivers.cameras.v4l2.grabber import V4L2Grabber

    return V4L2Grabber(options)


def discover() -> list[FoundDevice]:
    """List the capture devices, also those that cannot be used; code ``driver_missing`` on systems other than Linux."""
    _require_linux()
    from stereorig.drivers.cameras.v4l2 import discovery

    return discovery.discover()


def _require_linux() -> None:
    if platform.system() != "Linux":
        raise CameraError(
            f"V4L2 is a part of Linux, and this is {platform.system()}.",
            code="driver_missing",
            remedy="Use driver 'aravis', or a Linux machine.",
        )
