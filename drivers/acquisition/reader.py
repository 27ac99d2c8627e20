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

from core.errors import CameraError
from drivers.acquisition.clocks import DeviceClock
from drivers.acquisition.frame_counter import Arrival, SequenceReader
from drivers.cameras.protocol import Frame, FrameCounters, FrameGrabber, FrameStatus

# How long the thread waits in the grabber before it looks at the watchdog again
_SLICE_S = 0.02
_WATCHDOG_PERIODS = 3.0
# A busy host stops for longer than three periods of a fast camera, which is no fault of the camera's
_MIN_PATIENCE_S = 0.4


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
        True where frames come by themselves. Under software triggers the watchdog runs only after `trigger`.
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

    def stop(self) -> None:
        """End the thread and disarm the grabber; frames that wait can still be taken."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
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
                frame = self._grabber.next_frame(_SLICE_S)
                if frame is not None:
                    self._last_sign_s = time.monotonic()
                    self._sort(frame)
                elif self._overdue():
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
        with self._changed:
            self._fault = error
            self._changed.notify_all()
        if self._on_fault is not None:
            self._on_fault(error)

    def _sort(self, frame: Frame) -> None:
        reading = self._sequence.read(frame.sequence)
        last, count = self._last, self._counters
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
                    spoiled = replace(frame, sequence=reading.number)
            else:
                count = replace(count, delivered=count.delivered + 1)
                exposed_ns = self._clock.on_host(frame.device_ns, frame.host_ns)
                delivered = replace(frame, sequence=reading.number, exposed_ns=exposed_ns)
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

    def _is_stale(self, frame: Frame, last: Frame) -> bool:
        if frame.device_ns == last.device_ns:
            return True
        return self._compare_pixels and np.array_equal(frame.pixels, last.pixels)
