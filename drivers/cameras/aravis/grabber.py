"""A GenICam camera, GigE Vision or USB3 Vision, through Aravis."""

from __future__ import annotations

import threading
import time

from core.errors import CameraError
from drivers.cameras.aravis.session import Session
from drivers.cameras.protocol import CameraDescription, CameraOptions, CameraSettings, Frame

# Longest wait of `close` for the camera's release; a longer release goes on in a thread of its own
_CLOSE_S = 0.4
# A camera that is released by this process in the background may be free a moment later
_RELEASE_S = 0.5


class AravisGrabber:
    """A GenICam camera; see `drivers.cameras.protocol.FrameGrabber`.

    Feature reads of a camera that is gone take 2.5 s each, which nothing can shorten. So only `open`, `configure`,
    `arm`, `disarm` and `trigger` ask the camera; the others never wait for it.

    Parameters
    ----------
    options
        ``device`` is an id as `discover` lists it, a serial number, a MAC or an IP address.
    """

    def __init__(self, options: CameraOptions) -> None:
        self._options = options
        self._session: Session | None = None
        self._opening: Session | None = None
        self._releasing: threading.Thread | None = None
        self._closed = 0
        self._lock = threading.Lock()
        self._triggers = 0

    def open(self) -> None:
        """Connect; raises `CameraError` (``camera_lost``, ``camera_busy``, ``ptp_unsupported``, ``out_of_range``)."""
        with self._lock:
            releasing, closed = self._releasing, self._closed
            if self._session is not None:
                return
        if releasing is not None:
            releasing.join(_RELEASE_S)
        session = Session(self._options)
        with self._lock:
            self._opening = session
        try:
            session.open(self._triggers)
        except BaseException:
            self._release(session)
            raise
        with self._lock:
            self._opening = None
            if closed == self._closed:
                self._session = session
                return
        self._release(session)
        raise CameraError(
            f"{self._options.device} was closed while it was being opened.",
            code="camera_lost",
            remedy="Connect the camera again.",
            camera=self._options.device,
        )

    def describe(self) -> CameraDescription:
        """Return the camera's identity and abilities, as of the last `open`, `configure` or `arm`."""
        return self._opened().description

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set what is not ``None``; refuse all of it when one value cannot be had."""
        return self._opened().configure(settings)

    def arm(self) -> None:
        """Start delivering."""
        self._opened().arm()

    def disarm(self) -> None:
        """Stop delivering; waiting frames are discarded."""
        session = self._session
        if session is not None:
            session.disarm()

    def trigger(self) -> int | None:
        """Fire one software trigger; returns its number, counted since the grabber was made."""
        self._triggers = self._opened().trigger()
        return self._triggers

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame."""
        end = time.monotonic() + timeout_s
        while True:
            session = self._opened()
            frame = session.next_frame(max(0.0, end - time.monotonic()))
            if frame is not None or time.monotonic() >= end:
                return frame

    def statistics(self) -> dict[str, int | float]:
        """Counts of buffers and packets since the camera was opened; empty before."""
        session = self._session
        return {} if session is None else session.statistics()

    def close(self) -> None:
        """Release the camera; returns within half a second also when it is gone."""
        with self._lock:
            self._closed += 1
            session, self._session = self._session, None
            if self._opening is not None:
                self._opening.end()
        if session is not None:
            self._release(session)

    def _release(self, session: Session) -> None:
        session.end()
        thread = threading.Thread(target=session.release, name=f"release {self._options.device}", daemon=True)
        with self._lock:
            self._opening = None
            self._releasing = thread
        thread.start()
        thread.join(_CLOSE_S)

    def _opened(self) -> Session:
        session = self._session
        if session is None:
            raise CameraError(
                f"{self._options.device} is not open.",
                code="camera_lost",
                remedy="Connect the camera first.",
                camera=self._options.device,
            )
        return session
