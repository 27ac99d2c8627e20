"""A GenICam camera, GigE Vision or USB3 Vision, through Aravis."""

from __future__ import annotations

from stereorig.drivers.cameras.aravis.session import AravisSession
from stereorig.drivers.cameras.genicam.grabber import GenicamGrabber
from stereorig.drivers.cameras.protocol import CameraOptions


class AravisGrabber(GenicamGrabber):
    """A GenICam camera; see `stereorig.drivers.cameras.protocol.FrameGrabber`.

    Feature reads of a camera that is gone take 2.5 s each, which nothing can shorten. So only `open`, `configure`,
    `arm`, `disarm`, `trigger`, `latch` and `renew_clock` ask the camera; the others never wait for it.

    Parameters
    ----------
    options
        ``device`` is an id as `discover` lists it, a serial number, a MAC or an IP address.
    """

    def __init__(self, options: CameraOptions) -> None:
        super().__init__(options, AravisSession)
