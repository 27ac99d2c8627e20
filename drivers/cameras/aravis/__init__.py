"""GenICam cameras, GigE Vision and USB3 Vision, through the Aravis library (version 0.8).

Aravis is reached through PyGObject, both of which are loaded when a camera is first opened or looked for. Install them
with ``pip install 'stereorig[aravis]'`` and Debian's ``gir1.2-aravis-0.8``.
"""

from __future__ import annotations

from stereorig.drivers.cameras.aravis.connect import connected
from stereorig.drivers.cameras.aravis.discovery import discover
from stereorig.drivers.cameras.aravis.features import AravisFeatures
from stereorig.drivers.cameras.aravis.session import AravisGrabber
from stereorig.drivers.cameras.genicam.table import Feature, feature_table
from stereorig.drivers.cameras.protocol import CameraOptions, FrameGrabber

__all__ = ["discover", "look", "make"]


def make(options: CameraOptions) -> FrameGrabber:
    """Make a camera, not yet opened; see `stereorig.drivers.cameras.aravis.session.AravisGrabber`.

    Raises
    ------
    CameraError
        ``driver_missing`` when Aravis is not installed.
    """
    from stereorig.drivers.cameras.aravis.library import aravis

    aravis()
    return AravisGrabber(options)


def look(name: str) -> tuple[dict[str, str], list[Feature]]:
    """Return a camera's maker, model, protocol and description (XML), and its features; nothing of it is changed.

    Raises
    ------
    CameraError
        ``camera_lost``, ``camera_busy``, ``driver_missing``.
    """
    with connected(name) as device:
        about = {"vendor": device.text_of("get_vendor_name"), "model": device.text_of("get_model_name")}
        about |= {"protocol": device.protocol, "description": device.description()}
        return about, feature_table(AravisFeatures(device))
