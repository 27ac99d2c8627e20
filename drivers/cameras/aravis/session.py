"""One connection to a camera, from opening to its end; a camera that was lost needs a new one."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

from core.errors import CameraError
from drivers.cameras.aravis.connect import connect
from drivers.cameras.aravis.describe import describe, switch_ptp_on
from drivers.cameras.aravis.device import Device
from drivers.cameras.aravis.features import Features
from drivers.cameras.aravis.settings import CameraControl
from drivers.cameras.aravis.stream import CameraStream
from drivers.cameras.aravis.triggers import TriggerNumbers
from drivers.cameras.aravis.watch import Watch
from drivers.cameras.pixels import BY_NAME
from drivers.cameras.protocol import CameraDescription, CameraOptions, CameraSettings, Frame

# From the end of an exposure to the arrival of its frame's header: no camera takes that long
_LATENCY_S = 1.0
# What a camera may need to stop: one and a half frames, within these limits
_SHORTEST_S, _LONGEST_S = 0.05, 1.5
# A disarmed camera has no frames; a wait checks this often if it was armed
_IDLE_S = 0.02
#: features that change the size of a frame or what starts it, and so cannot change while frames come
_NOT_WHILE_ARMED = ("PixelFormat", "Width", "Height", "Binning", "Decimation", "Chunk", "GevSCPS", "Trigger")


class Session:
    """An opened camera with its stream.

    Made in two steps, so that `close` can end it while it is being opened.

    Parameters
    ----------
    options
        Name of the camera, and its options.
    """

    description: CameraDescription

    def __init__(self, options: CameraOptions) -> None:
        self._options = options
        self._asking = threading.RLock()  # features may be used by one thread at a time
        self._ended = threading.Event()
        self._why_lost: list[str] = []  # filled by threads that watch the camera; the first counts
        self._last_frame_s = 0.0
        self._stopped_s = 0.0
        self._watch: Watch | None = None
        self._device = Device(options, self._check)
        self._stream: CameraStream | None = None
        self._earlier: dict[str, int | float] = {}

    def open(self, triggers_before: int) -> None:
        """Connect and prepare; when something fails, `release` is still to be called."""
        with self._asking:
            why_lost = self._why_lost  # the handler must not keep the connection alive
            connect(self._device, self._options, lambda: why_lost.append("was unplugged"))
            self._stopped_s = time.monotonic()
            self._features = Features(self._device)
            self._control = CameraControl(self._device, self._features, self._options)
            if self._options.ptp:
                switch_ptp_on(self._device, self._features)
            if "AcquisitionMode" in self._features.names:
                self._features.write("AcquisitionMode", "Continuous")
            self._settings = self._control.read()
            self._describe()
            self._triggers = TriggerNumbers(*self.description.counter_range, before=triggers_before)
            if self._device.is_gige:
                self._watch = Watch(
                    self._device.address(), lambda: self._last_frame_s, self._device.in_control, why_lost.append
                )
                self._watch.start()

    def _describe(self) -> None:
        self.description = describe(self._device, self._features, self._control)

    def _check(self) -> None:
        if self._ended.is_set():
            raise self._device.lost("was closed")
        if self._why_lost:
            raise self._device.lost(self._why_lost[0])

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `drivers.cameras.protocol.FrameGrabber.configure`."""
        with self._asking:
            self._check()
            if self._stream is not None:
                self._refuse_while_armed(settings)
            self._settings = self._control.apply(settings)
            self._describe()
            return self._settings

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
                f"{self._device.name} cannot change {', '.join(names)} while it is armed.",
                code="armed",
                remedy="Disarm it first.",
                camera=self._device.name,
            )

    def arm(self) -> None:
        """Start the stream and the acquisition."""
        with self._asking:
            self._check()
            if self._stream is not None:
                return
            self._settings = self._control.read()
            self._describe()
            region, name = self._settings.region_px, self._settings.pixel_format
            if region is None or name not in BY_NAME:
                raise CameraError(
                    f"{self._device.name} is set to pixel format {name}, which cannot be read here.",
                    code="frame_format",
                    remedy="Set bit_depth, or one of the pixel formats in the camera's description.",
                    camera=self._device.name,
                )
            self._triggers.arm()
            self._await_standstill()
            stream = CameraStream(self._device.name, region_px=region, pixel_format=BY_NAME[name])
            stream.start(self._device, self._options.buffers)
            self._stream = stream
            try:
                self._device.ask_camera("start_acquisition")
            except CameraError:
                self._end_stream()
                raise

    def _await_standstill(self) -> None:
        # a stopped camera finishes its frame first; without the time for it, it goes on sending to the stream that is
        # gone
        rate = self._settings.frame_rate_hz
        frame_s = max(1.0 / rate if rate else 0.0, (self._settings.exposure_ms or 0.0) / 1000.0)
        left = self._stopped_s + min(1.5 * frame_s + _SHORTEST_S, _LONGEST_S) - time.monotonic()
        if left > 0:
            self._ended.wait(left)
            self._check()

    def disarm(self) -> None:
        """Stop the acquisition and end the stream; a camera that is gone is not waited for."""
        stream = self._stream
        if stream is None:
            return
        stream.end()  # waits end at once, also while another thread asks the camera
        thread = threading.Thread(target=self._end_stream, name=f"disarm {self._device.name}", daemon=True)
        thread.start()
        while thread.is_alive() and not self._why_lost and not self._ended.is_set():
            thread.join(_IDLE_S)

    def _end_stream(self) -> None:
        with self._asking:
            stream, self._stream = self._stream, None
            if stream is not None:
                stream.end()
                if not self._why_lost:
                    self._device.stop()
                    self._stopped_s = time.monotonic()
                self._earlier = _sum(self._earlier, stream.release())

    def trigger(self) -> int:
        """Fire a software trigger."""
        with self._asking:
            self._check()
            if self._settings.trigger != "software":
                raise CameraError(
                    f"{self._device.name} is in trigger mode {self._settings.trigger!r}, not 'software'.",
                    code="wrong_trigger",
                    remedy="Set trigger to 'software' first.",
                    camera=self._device.name,
                )
            if self._stream is None:
                raise CameraError(
                    f"{self._device.name} is not armed.",
                    code="not_armed",
                    remedy="Arm it before it is triggered.",
                    camera=self._device.name,
                )
            return self._triggers.fire(self._fire)

    def _fire(self) -> None:
        self._device.ask("execute_command", "TriggerSoftware")

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
        # should a camera count further than it said, its numbers still follow each other
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
            self._device.drop()


def _sum(one: dict[str, int | float], two: dict[str, int | float]) -> dict[str, int | float]:
    return {name: one.get(name, 0) + two.get(name, 0) for name in {**one, **two}}
