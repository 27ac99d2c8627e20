"""One thread a camera that takes frames from the grabber, refuses frames that are no measurement images, and counts.

Every frame number since `CameraReader.start` is in the counters: ``delivered + overrun + dropped + incomplete`` is the
advance of the camera's counter. Repeats and late frames are additional, since their numbers are already counted. A
watchdog of its own declares a camera lost that is silent for three frame periods (0.4 s at least), regardless of its
library.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.drivers.acquisition.clocks import DeviceClock
from stereorig.drivers.acquisition.frame_counter import Arrival, SequenceReader
from stereorig.drivers.cameras.protocol import (
    CameraDescription,
    Frame,
    FrameCounters,
    FrameGrabber,
    FrameStatus,
    Latch,
    LatchingGrabber,
)

# How long the thread waits in the grabber before it looks at the watchdog again
_SLICE_S = 0.02
_WATCHDOG_PERIODS = 3.0
# A busy host stops for longer than three periods of a fast camera, which is no fault of the camera's
_MIN_PATIENCE_S = 0.4
# Latches of the camera's clock: so many at first, then the quickest of a few each second
_FIRST_LATCHES, _LATCHES, _LATCH_PAUSE_S = 8, 3, 1.0
# A reading that takes so long is the last for a while: twenty times as long as it took
_LATE_LATCH_S, _LATCH_SHARE = 0.05, 20.0


class CameraReader:
    """Reads one armed grabber.

    Parameters
    ----------
    grabber
        Opened and configured; the reader arms and disarms it.
    name
        For error texts: ``cam1``.
    period_s
        Frame period in free run or under a hardware trigger; under software triggers, the longest time from a trigger
        to its frame.
    expects_frames
        True if frames come by themselves. Under software triggers the watchdog runs only after `trigger`.
    buffer_frames
        Frames that may wait for the consumer; when it is too slow, the oldest is thrown away and counted.
    sequence
        Reader of the camera's counter.
    compare_pixels
        Also refuse a frame whose pixels equal the last frame's: a stale buffer under a new number. Not for cameras
        that can deliver the same picture twice, such as noise-free simulated ones.
    pass_incomplete
        Deliver incomplete frames too, with their status, so that pairing can count their triggers.
    on_fault
        Called once, from the reader's thread, when the camera is lost.
    on_clock
        Called with the camera's description when the clock was looked at again, from a thread of its own.
    """

    def __init__(
        self,
        grabber: FrameGrabber,
        *,
        name: str,
        period_s: float,
        expects_frames: bool,
        buffer_frames: int = 8,
        sequence: SequenceReader | None = None,
        compare_pixels: bool = False,
        pass_incomplete: bool = False,
        on_fault: Callable[[CameraError], None] | None = None,
        on_clock: Callable[[CameraDescription], None] | None = None,
    ) -> None:
        self._grabber = grabber
        self._name = name
        latency_s = grabber.describe().latency_s
        self._patience_s = max(_WATCHDOG_PERIODS * period_s, _MIN_PATIENCE_S) + latency_s
        self._expects_frames = expects_frames
        self._sequence = sequence if sequence is not None else SequenceReader()
        self._compare_pixels = compare_pixels
        self._pass_incomplete = pass_incomplete
        self._on_fault = on_fault
        self._on_clock = on_clock
        self._stopped = threading.Event()
        self._clock = DeviceClock()
        self._buffer: deque[Frame] = deque()
        self._room = buffer_frames
        self._changed = threading.Condition()
        self._counters = FrameCounters()
        self._fault: CameraError | None = None
        self._ending = False
        self._waiting = 0
        self._last_sign_s = time.monotonic()
        self._last: Frame | None = None
        self._thread: threading.Thread | None = None

    @property
    def counters(self) -> FrameCounters:
        """Counters of the frames so far."""
        with self._changed:
            return self._counters

    def device_ns(self, host_ns: int) -> int | None:
        """Return the camera's time at a time of the host's monotonic clock; None if it cannot be asked for it."""
        return self._clock.device_ns(host_ns)

    @property
    def notes(self) -> dict[str, str]:
        """Return the device's duties that this reader takes over, by name."""
        notes = {}
        if self._sequence.counts:
            notes["frame_counter"] = "counted here: the device's number stays the same, so lost frames leave no gap"
        if self._last is not None and self._last.device_ns == self._last.host_ns:
            notes["timestamp"] = "of the arrival: the device gives none"
        return notes

    @property
    def fault(self) -> CameraError | None:
        """Error by which the camera was lost, or None."""
        with self._changed:
            return self._fault

    def start(self) -> None:
        """Arm the grabber and start reading."""
        self._grabber.arm()
        self._last_sign_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"reader {self._name}", daemon=True)
        self._thread.start()
        if isinstance(self._grabber, LatchingGrabber):
            # not waited for at the end: it may be asking a camera that is gone
            watch = (self._grabber,)
            threading.Thread(target=self._watch_clock, args=watch, name=f"clock {self._name}", daemon=True).start()

    def _watch_clock(self, grabber: LatchingGrabber) -> None:
        kept, asked, pause_s = _FIRST_LATCHES, _FIRST_LATCHES, 0.0
        while not self._stopped.wait(pause_s):
            try:
                found, longest_s = _latches(grabber, asked)
                description = grabber.renew_clock()
            except CameraError:
                return  # the reader raises the reason
            for latch in sorted(sorted(found, key=lambda one: one.after_ns - one.before_ns)[:kept]):
                self._clock.tie(latch)
            if self._on_clock is not None and not self._stopped.is_set():
                self._on_clock(description)
            # one that has no latch is not asked for it again; one that answers late has other questions to answer too
            kept, asked = 1, _LATCHES if found else 0
            pause_s = max(_LATCH_PAUSE_S, _LATCH_SHARE * longest_s)

    def stop(self) -> None:
        """End the thread and disarm the grabber; frames that wait can still be taken."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._fault is None:
            self._grabber.disarm()

    def trigger(self) -> int | None:
        """Fire the grabber's software trigger and start its watchdog."""
        self._raise_fault()
        with self._changed:
            if self._waiting == 0:
                self._last_sign_s = time.monotonic()
            self._waiting += 1
        return self._grabber.trigger()

    def take(self, timeout_s: float) -> Frame | None:
        """Return the oldest frame that waits, its sequence number unwrapped; ``None`` when none came in time.

        Raises
        ------
        CameraError
            When the camera is lost and no frame waits any more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._buffer or self._fault or self._ending, timeout_s)
            if self._buffer:
                return self._buffer.popleft()
        self._raise_fault()
        return None

    def _raise_fault(self) -> None:
        fault = self.fault
        if fault is not None:
            # the same fault may be raised many times: each caller gets an error of its own
            raise CameraError(fault.cause, code=fault.code, remedy=fault.remedy, **fault.context)

    def _run(self) -> None:
        try:
            while not self._ending:
                begun_s = time.monotonic()
                frame = self._grabber.next_frame(_SLICE_S)
                if frame is not None:
                    self._last_sign_s = time.monotonic()
                    self._sort(frame)
                    continue
                # a busy host held this thread up, and perhaps the driver's threads too: no silence of the camera
                self._last_sign_s += max(0.0, time.monotonic() - begun_s - 2.0 * _SLICE_S)
                if self._overdue():
                    raise CameraError(
                        f"{self._name} has been silent for {self._patience_s:.2f} s: three frame periods, or 0.4 s.",
                        code="camera_lost",
                        remedy="Check its cable and power, then reconnect.",
                        camera=self._name,
                    )
        except CameraError as error:
            self._lose(error)
        except Exception as error:  # noqa: BLE001  # a reader that dies unseen would look like a silent camera
            fault = CameraError(f"The driver of {self._name} failed: {error!r}.", camera=self._name)
            fault.__cause__ = error
            self._lose(fault)

    def _overdue(self) -> bool:
        with self._changed:
            expecting = self._expects_frames or self._waiting > 0
            return expecting and time.monotonic() - self._last_sign_s > self._patience_s

    def _lose(self, error: CameraError) -> None:
        self._stopped.set()
        with self._changed:
            self._fault = error
            self._changed.notify_all()
        if self._on_fault is not None:
            self._on_fault(error)

    def _sort(self, frame: Frame) -> None:
        if frame.device_ns == 0:  # from a device that does not stamp
            frame = replace(frame, device_ns=frame.host_ns)
        last, count = self._last, self._counters
        reading = self._sequence.read(frame.sequence, fresh=last is not None and frame.device_ns != last.device_ns)
        delivered: Frame | None = None
        spoiled: Frame | None = None
        stale = last is not None and reading.arrival is Arrival.NEXT and self._is_stale(frame, last)
        if reading.arrival is Arrival.LATE:
            count = replace(count, out_of_order=count.out_of_order + 1)
        elif reading.arrival is Arrival.DUPLICATE:
            count = replace(count, duplicates=count.duplicates + 1)
        else:
            count = replace(count, dropped=count.dropped + reading.missing)
            if stale:
                # its own picture never came
                count = replace(count, duplicates=count.duplicates + 1, dropped=count.dropped + 1)
            elif frame.status is not FrameStatus.OK:
                count = replace(count, incomplete=count.incomplete + 1)
                if self._pass_incomplete:
                    spoiled = self._timed(frame, reading.number)
            else:
                count = replace(count, delivered=count.delivered + 1)
                delivered = self._timed(frame, reading.number)
                self._last = frame
        with self._changed:
            if reading.arrival is Arrival.NEXT:
                self._waiting = max(0, self._waiting - 1 - reading.missing)
            if delivered is not None:
                if len(self._buffer) >= self._room and self._buffer.popleft().status is FrameStatus.OK:
                    count = replace(count, delivered=count.delivered - 1, overrun=count.overrun + 1)
                self._buffer.append(delivered)
            elif spoiled is not None and len(self._buffer) < self._room:
                self._buffer.append(spoiled)
            self._counters = count
            self._changed.notify_all()

    def _timed(self, frame: Frame, number: int) -> Frame:
        """Return the frame with its number and the times that its clock gives; a damaged one may have a wrong stamp."""
        stamped = frame.device_ns != frame.host_ns
        latched = self._clock.latched(frame.device_ns, frame.host_ns) if stamped else None
        begun_ns, error_ns = latched or (None, 0)
        exposed_ns = None
        if frame.status is FrameStatus.OK:
            exposed_ns = self._clock.on_host(frame.device_ns, frame.host_ns)
        return replace(
            frame,
            sequence=number,
            exposed_ns=exposed_ns,
            latched_ns=begun_ns,
            latched_error_ns=error_ns,
            stamped=stamped,
        )

    def _is_stale(self, frame: Frame, last: Frame) -> bool:
        if frame.device_ns == last.device_ns:
            return True
        return self._compare_pixels and np.array_equal(frame.pixels, last.pixels)


def _latches(grabber: LatchingGrabber, most: int) -> tuple[list[Latch], float]:
    """Return some readings of a camera's clock, fewer of a camera that answers late, and the longest time of one."""
    found: list[Latch] = []
    longest_s = 0.0
    while most > 0 and longest_s < _LATE_LATCH_S:
        begun_s = time.monotonic()
        latch = grabber.latch()
        longest_s = max(longest_s, time.monotonic() - begun_s)
        most = 0 if latch is None else most - 1
        found += [] if latch is None else [latch]
    return found, longest_s
