"""GenICam cameras, GigE Vision and USB3 Vision, through the Aravis library (version 0.8).

Aravis is reached through PyGObject, both of which are loaded when a camera is first opened or looked for. Install them
with ``pip install 'stereorig[aravis]'`` and Debian's ``gir1.2-aravis-0.8``.
"""

from __future__ import annotations

from drivers.cameras.aravis.discovery import discover
from drivers.cameras.aravis.grabber import AravisGrabber
from drivers.cameras.protocol import CameraOptions, FrameGrabber

__all__ = ["discover", "make"]


def make(options: CameraOptions) -> FrameGrabber:
    """Make a camera, not yet opened; see `drivers.cameras.aravis.grabber.AravisGrabber`.

    Raises
    ------
    CameraError
        ``driver_missing`` when Aravis is not installed.
    """
    from drivers.cameras.aravis.library import aravis

    aravis()
    return AravisGrabber(options)
