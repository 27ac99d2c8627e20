"""Basler's cameras, GigE Vision and USB3 Vision, through Basler's own pylon (package ``pypylon``).

The library is loaded when a camera is first opened or looked for. Install it with ``pip install 'stereorig[pylon]'``.
"""

from __future__ import annotations

import contextlib

from stereorig.drivers.cameras.genicam.grabber import GenicamGrabber
from stereorig.drivers.cameras.genicam.table import Feature, feature_table
from stereorig.drivers.cameras.protocol import CameraOptions, FoundDevice, FrameGrabber

__all__ = ["discover", "look", "make"]


def make(options: CameraOptions) -> FrameGrabber:
    """Make a camera, not yet opened; ``device`` is its serial number, full name, own name, MAC or IP address.

    Raises
    ------
    CameraError
        ``driver_missing`` when pypylon is not installed.
    """
    from stereorig.drivers.cameras.pylon.library import pylon
    from stereorig.drivers.cameras.pylon.session import PylonSession

    pylon()
    return GenicamGrabber(options, PylonSession)


def discover() -> list[FoundDevice]:
    """List the cameras that pylon finds; raises as `make`."""
    from stereorig.drivers.cameras.pylon.discovery import found_devices

    return found_devices()


def look(name: str) -> tuple[dict[str, str], list[Feature]]:
    """Return a camera's maker, model and protocol, and its features; pylon hands out no description. Raises as `make`.

    The camera's settings are not changed.
    """
    from stereorig.drivers.cameras.pylon.device import PylonDevice
    from stereorig.drivers.cameras.pylon.features import PylonFeatures

    with contextlib.ExitStack() as stack:
        device = PylonDevice(CameraOptions(device=name), lambda: None)
        stack.callback(device.drop)
        device.connect(1)
        features = PylonFeatures(device)
        stack.callback(features.release)
        about = {"vendor": device.listed("VendorName"), "model": device.listed("ModelName")}
        return {**about, "protocol": device.protocol, "description": ""}, feature_table(features)
