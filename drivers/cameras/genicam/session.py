"""One connection to a GenICam camera, from opening to its end; a camera that was lost needs a new one."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Protocol

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.describe import choose_place, switch_ptp_on, temperature_c, with_clock
from stereorig.drivers.cameras.genicam.errors import NamedCamera
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.genicam.link import hold_back
from stereorig.drivers.cameras.genicam.settings import CameraControl
from stereorig.drivers.cameras.genicam.synonyms import TICK_FREQUENCY
from stereorig.drivers.cameras.genicam.triggers import TriggerNumbers
from stereorig.drivers.cameras.genicam.watch import Watch
from stereorig.drivers.cameras.pixels import BY_NAME, PixelFormat
from stereorig.drivers.cameras.protocol import CameraDescription, CameraOptions, CameraSettings, Frame, Latch

# From the end of an exposure to the arrival of its frame's header: no camera takes that long
_LATENCY_S = 1.0
# A disarmed camera has no frames; a wait checks this often if it was armed
_IDLE_S = 0.02
#: features that change the size of a frame or the start of its exposure, and so cannot change while frames come
_NOT_WHILE_ARMED = ("PixelFormat", "Width", "Height", "Binning", "Decimation", "Chunk", "GevSCPS", "Trigger")


class FrameStream(Protocol):
    """Frames of a camera from arming to disarming; ``headerless`` counts those whose number is not known."""

    headerless: int

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for a frame; ends early, with None, when the stream is ended."""

    def statistics(self) -> dict[str, int | float]:
        """Return the library's counters; does not ask the camera."""

    def end(self) -> None:
        """Let waits end."""

    def release(self) -> dict[str, int | float]:
        """Free the buffers and return the last counts."""


class CameraSession(ABC):
    """An opened camera with its stream.

    Made in two steps, so that `close` can end it while it is being opened.

    Parameters
    ----------
    options
        Name of the camera, and its options.
    """

    description: CameraDescription
    _camera: NamedCamera
    _features: CameraFeatures
    _control: CameraControl

    def __init__(self, options: CameraOptions) -> None:
        self._options = options
        self._asking = threading.RLock()  # features may be used by one thread at a time
        self._ended = threading.Event()
        self._why_lost: list[str] = []  # filled by threads that watch the camera; the first counts
        self._last_frame_s = 0.0
        self._stream: FrameStream | None = None
        self._watch: Watch | None = None
        self._earlier: dict[str, int | float] = {}

    @abstractmethod
    def _connect(self) -> None:
        """Connect; set the features and the control."""

    @abstractmethod
    def _address(self) -> str:
        """Return the IP address of a GigE Vision camera, or an empty string."""

    @abstractmethod
    def _in_control(self) -> bool:
        """Return True if the camera is still under control, as far as is known without asking it."""

    @abstractmethod
    def _describe(self) -> CameraDescription:
        """Read the camera's identity and abilities."""

    @abstractmethod
    def _make_stream(self, region_px: tuple[int, int, int, int], pixel_format: PixelFormat) -> FrameStream:
        """Return a stream that takes frames, of a camera that does not send yet."""

    @abstractmethod
    def _start(self) -> None:
        """Let the camera send."""

    @abstractmethod
    def _stop(self) -> None:
        """Ask the camera to stop sending; raises nothing."""

    @abstractmethod
    def _fire(self) -> None:
        """Send one software trigger."""

    @abstractmethod
    def _drop(self) -> None:
        """Give the camera back."""

    def _ticks_per_s(self) -> float:
        """Return the ticks of the camera's clock in a second; one without a frequency counts nanoseconds."""
        name = self._features.first(TICK_FREQUENCY)
        return (0.0 if name is None else self._features.read_number(name)) or 1e9

    def open(self, triggers_before: int) -> None:
        """Connect and prepare; when something fails, `release` is still to be called."""
        with self._asking:
            self._connect()
            if self._options.ptp:
                switch_ptp_on(self._camera, self._features)
            choose_place(self._features)
            self._control.run_continuously()
            self._settings = self._control.read()
            self.description = self._describe()
            self._triggers = TriggerNumbers(*self.description.counter_range, before=triggers_before)
            address = self._address()
            if address:
                # the libraries notice the loss of a camera that waits for triggers after some seconds only
                self._watch = Watch(address, lambda: self._last_frame_s, self._in_control, self._lose)
                self._watch.start()

    def _lose(self, why: str) -> None:
        self._why_lost.append(why)
        stream = self._stream
        if stream is not None:
            stream.end()  # so that a wait for a frame ends at once

    def _check(self) -> None:
        if self._ended.is_set():
            raise self._camera.lost("was closed")
        if self._why_lost:
            raise self._camera.lost(self._why_lost[0])

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `stereorig.drivers.cameras.protocol.FrameGrabber.configure`."""
        with self._asking:
            self._check()
            if self._stream is not None:
                self._refuse_while_armed(settings)
            self._settings = self._control.apply(settings)
            self.description = self._describe()
            return self._settings

    def hold_back(self, bytes_per_s: float, link_bytes_per_s: float) -> None:
        """Limit the bytes a second that the camera, disarmed, sends; see `stereorig.drivers.cameras.genicam.link`."""
        with self._asking:
            self._check()
            hold_back(self._features, bytes_per_s, link_bytes_per_s, self._ticks_per_s())

    def _refuse_while_armed(self, settings: CameraSettings) -> None:
        names = [
            name
            for name in ("bit_depth", "pixel_format", "region_px", "trigger")
            if getattr(settings, name) not in (None, getattr(self._settings, name))
        ]
        for name in settings.features or {}:
            if name.startswith(_NOT_WHILE_ARMED) or (name in self._features.names and self._features.locked(name)):
                names.append(name)
        if names:
            raise CameraError(
                f"{self._camera.name} cannot change {', '.join(names)} while it is armed.",
                code="armed",
                remedy="Disarm it first.",
                camera=self._camera.name,
            )

    def arm(self) -> None:
        """Start the stream and the acquisition."""
        with self._asking:
            self._check()
            if self._stream is not None:
                return
            self._settings = self._control.read()
            self.description = self._describe()
            region, name = self._settings.region_px, self._settings.pixel_format
            if region is None or name not in BY_NAME:
                raise CameraError(
                    f"{self._camera.name} is set to pixel format {name}, which cannot be read here.",
                    code="frame_format",
                    remedy="Set bit_depth, or one of the pixel formats in the camera's description.",
                    camera=self._camera.name,
                )
            self._triggers.arm()
            self._stream = self._make_stream(region, BY_NAME[name])
            try:
                self._start()
            except CameraError:
                self._end_stream()
                raise

    def disarm(self) -> None:
        """Stop the acquisition and end the stream; a camera that is gone is not waited for."""
        stream = self._stream
        if stream is None:
            return
        stream.end()  # waits end at once, also while another thread asks the camera
        thread = threading.Thread(target=self._end_stream, name=f"disarm {self._camera.name}", daemon=True)
        thread.start()
        while thread.is_alive() and not self._why_lost and not self._ended.is_set():
            thread.join(_IDLE_S)

    def _end_stream(self) -> None:
        with self._asking:
            stream, self._stream = self._stream, None
            if stream is not None:
                stream.end()
                if not self._why_lost:
                    self._stop()
                self._earlier = _sum(self._earlier, stream.release())

    def trigger(self) -> int:
        """Fire a software trigger."""
        with self._asking:
            self._check()
            if self._settings.trigger != "software":
                raise CameraError(
                    f"{self._camera.name} is in trigger mode {self._settings.trigger!r}, not 'software'.",
                    code="wrong_trigger",
                    remedy="Set trigger to 'software' first.",
                    camera=self._camera.name,
                )
            if self._stream is None:
                raise CameraError(
                    f"{self._camera.name} is not armed.",
                    code="not_armed",
                    remedy="Arm it before it is triggered.",
                    camera=self._camera.name,
                )
            return self._triggers.fire(self._fire)

    def latch(self) -> Latch | None:
        """Return the camera's time now; None if it cannot be asked for it."""
        return None

    def renew_clock(self) -> CameraDescription:
        """Read again the clock that rules the camera's, if it was set to follow one, and the camera's temperature."""
        with self._asking:
            self._check()
            if self._options.ptp:
                self.description = with_clock(self.description, self._features)
            self.description = replace(self.description, temperature_c=temperature_c(self._features))
        return self.description

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for a frame, or sleep while the camera is not armed."""
        self._check()
        stream = self._stream
        if stream is None:
            time.sleep(min(timeout_s, _IDLE_S))
            return None
        frame = stream.next_frame(timeout_s)
        if frame is None:
            self._check()
            return None
        self._last_frame_s = time.monotonic()
        first, last = self.description.counter_range
        # if a camera counts beyond its stated range, its numbers still follow each other
        number = first + (frame.sequence - first) % (last - first + 1)
        trigger = None
        if self._settings.trigger == "software":
            patience_s = (self._settings.exposure_ms or 0.0) / 1000.0 + _LATENCY_S
            trigger = self._triggers.of_frame(number, frame.host_ns, patience_s, stream.headerless)
        return replace(frame, sequence=number, trigger=trigger)

    def statistics(self) -> dict[str, int | float]:
        """Counts of all streams since the camera was opened."""
        stream = self._stream
        return _sum(self._earlier, {} if stream is None else stream.statistics())

    def end(self) -> None:
        """Let every wait end; no new question is put to the camera."""
        self._ended.set()
        if self._watch is not None:
            self._watch.end()
        stream = self._stream
        if stream is not None:
            stream.end()

    def release(self) -> None:
        """Give the camera back; takes some milliseconds, or up to 8 s for a camera that is gone."""
        self.end()
        with self._asking:
            self._end_stream()
            self._drop()


def _sum(one: dict[str, int | float], two: dict[str, int | float]) -> dict[str, int | float]:
    return {name: one.get(name, 0) + two.get(name, 0) for name in {**one, **two}}
