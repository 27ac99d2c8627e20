"""A GenICam camera, opened and closed by sessions of any library."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.session import CameraSession
from stereorig.drivers.cameras.protocol import CameraDescription, CameraOptions, CameraSettings, Frame, Latch

# Longest wait of `close` for the camera's release; a longer release continues in a thread of its own
_CLOSE_S = 0.4
# A camera that is released by this process in the background may be free a moment later
_RELEASE_S = 0.5


class GenicamGrabber:
    """A GenICam camera; see `stereorig.drivers.cameras.protocol.FrameGrabber`.

    Parameters
    ----------
    options
        Name of the camera, and its options.
    make_session
        Makes a connection, not yet opened.
    """

    def __init__(self, options: CameraOptions, make_session: Callable[[CameraOptions], CameraSession]) -> None:
        self._make_session = make_session
        self._options = options
        self._session: CameraSession | None = None
        self._opening: CameraSession | None = None
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
        session = self._make_session(self._options)
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
        """Set the values that are not ``None``; refuse all of them if one cannot be set."""
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

    def latch(self) -> Latch | None:
        """Return the camera's time now; `stereorig.drivers.cameras.protocol.LatchingGrabber`."""
        return self._opened().latch()

    def renew_clock(self) -> CameraDescription:
        """Return the description with the clock that rules the camera's, and its temperature, now."""
        return self._opened().renew_clock()

    def hold_back(self, bytes_per_s: float, link_bytes_per_s: float) -> None:
        """Let the camera send at most so many bytes a second; `stereorig.drivers.cameras.protocol.LatchingGrabber`."""
        self._opened().hold_back(bytes_per_s, link_bytes_per_s)

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

    def _release(self, session: CameraSession) -> None:
        session.end()
        thread = threading.Thread(target=session.release, name=f"release {self._options.device}", daemon=True)
        with self._lock:
            self._opening = None
            self._releasing = thread
        thread.start()
        thread.join(_CLOSE_S)

    def _opened(self) -> CameraSession:
        session = self._session
        if session is None:
            raise CameraError(
                f"{self._options.device} is not open.",
                code="camera_lost",
                remedy="Connect the camera first.",
                camera=self._options.device,
            )
        return session
