"""The stream of one armed camera: its ring of buffers, and Aravis' counters of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.device import AravisDevice
from stereorig.drivers.cameras.aravis.library import aravis, buffer_bytes
from stereorig.drivers.cameras.genicam.errors import unreadable
from stereorig.drivers.cameras.pixels import BY_CODE, PixelFormat, unpack
from stereorig.drivers.cameras.protocol import Frame, FrameStatus, Pixels

#: a frame that lacks packets is given up this long after its last one; so frames may come so much later
RETENTION_S = 0.05
_PACKET_TIMEOUT_S = 0.01
# a cut-off wait is noticed this often
_SLICE_S = 0.02
#: Aravis' count -> ours
_INFOS = {
    "n_completed_buffers": "completed_buffers",
    "n_failures": "failed_buffers",
    "n_underruns": "underruns",
    "n_timeouts": "timeouts",
    "n_aborted": "aborted_buffers",
    "n_missing_frames": "missing_frames",
    "n_size_mismatch_errors": "size_mismatches",
    "n_received_packets": "received_packets",
    "n_missing_packets": "missing_packets",
    "n_error_packets": "error_packets",
    "n_ignored_packets": "ignored_packets",
    "n_resend_requests": "resend_requests",
    "n_resent_packets": "resent_packets",
    "n_duplicated_packets": "duplicated_packets",
    "n_transferred_bytes": "transferred_bytes",
}
#: counts of this moment, which do not add up
_PRESENT = ("free_buffers", "waiting_frames")


# Between two looks at the clocks (20 ms) the kernel's slewing shifts them by 10 us at most
_STEP_NS = 2_000_000


class ArrivalClock:
    """Converts Aravis' arrival times, by the wall clock, into times of the monotonic clock.

    The wall clock may be set while frames wait. Such a step shows as a change of the difference between both clocks;
    frames that had come before it then get the time at which they are taken.

    Parameters
    ----------
    wall_ns, steady_ns
        The clocks, in ns.
    """

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, steady_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns = wall_ns
        self._steady_ns = steady_ns
        self._difference = self._measure()
        self._doubtful = 0
        self._stepped = False

    def _measure(self) -> int:
        # the thread may be suspended between both readings: the quickest of three counts
        readings = []
        for _ in range(3):
            before = self._steady_ns()
            wall = self._wall_ns()
            after = self._steady_ns()
            readings.append((after - before, wall - (before + after) // 2))
        return min(readings)[1]

    def watch(self) -> None:
        """Look at the clocks; to be called often."""
        difference = self._measure()
        if abs(difference - self._difference) > _STEP_NS:
            self._stepped = True
        self._difference = difference

    def monotonic_ns(self, wall_ns: int, waiting: int) -> int:
        """Return when a frame arrived, and expect ``waiting`` more that may have come before it was taken."""
        self.watch()
        now = self._steady_ns()
        if self._stepped:
            self._stepped = False
            self._doubtful = waiting + 1
        arrived = wall_ns - self._difference
        if self._doubtful > 0:
            self._doubtful -= 1
            return now
        return min(arrived, now)


class CameraStream:
    """Frames of a camera from arming to disarming.

    Parameters
    ----------
    name
        The camera's, for error texts.
    region_px, pixel_format
        Present settings of the camera, for frames that come without their header.
    """

    def __init__(self, name: str, *, region_px: tuple[int, int, int, int], pixel_format: PixelFormat) -> None:
        self._name = name
        self._width, self._height = region_px[2:]
        self._format = pixel_format
        self._clock = ArrivalClock()
        self.headerless = 0  # frames whose number is not known
        self._ended = False
        self._users = 0
        self._changed = threading.Condition()
        self._stream: Any = None

    def start(self, device: AravisDevice, buffers: int) -> None:
        """Let the camera's frames come.

        Parameters
        ----------
        device
            The camera, connected.
        buffers
            Frames that may be under way.
        """
        self._stream, payload = device.start_stream()
        if device.is_gige:
            gv = aravis()
            self._stream.set_property("packet-resend", gv.GvStreamPacketResend.ALWAYS)
            self._stream.set_property("socket-buffer", gv.GvStreamSocketBuffer.AUTO)
            self._stream.set_property("packet-timeout", round(_PACKET_TIMEOUT_S * 1e6))
            self._stream.set_property("frame-retention", round(RETENTION_S * 1e6))
        for _ in range(max(2, buffers)):
            _give_back(self._stream, aravis().Buffer.new_allocate(payload))

    @contextmanager
    def _in_use(self, *, even_ended: bool = False) -> Iterator[Any]:
        """Return the stream, or None once it has ended; it is not freed in between.

        Freeing waits for the camera, so it must happen in the thread that calls `release` and in no other.
        """
        with self._changed:
            stream = None if self._ended and not even_ended else self._stream
            self._users += 1
        try:
            yield stream
        finally:
            del stream
            with self._changed:
                self._users -= 1
                self._changed.notify_all()

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for a frame; ends early, with None, when the stream is ended."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._clock.watch()
            left = deadline - time.monotonic()
            with self._in_use() as stream:
                if stream is None:
                    return None
                # PyGObject lets other threads run while it waits in here
                buffer = stream.timeout_pop_buffer(round(max(0.0, min(left, _SLICE_S)) * 1e6))
                taken = None if buffer is None else self._take(stream, buffer)
                del stream
            if isinstance(taken, CameraError):
                raise taken
            if taken is not None:
                return taken
            if buffer is None and left <= 0:
                return None
            del buffer

    def _take(self, stream: Any, buffer: Any) -> Frame | CameraError | None:
        statuses = aravis().BufferStatus
        try:
            status = buffer.get_status()
            if not buffer.get_system_timestamp():
                # never filled, or the packet with the frame's number was lost: the gap in the numbers will show it
                self.headerless += status not in (statuses.CLEARED, statuses.ABORTED)
                return None
            host_ns = self._clock.monotonic_ns(int(buffer.get_system_timestamp()), int(stream.get_n_buffers()[1]))
            known, pixels = self._format, None
            if status == statuses.SUCCESS:
                code = int(buffer.get_image_pixel_format())
                if code not in BY_CODE:
                    return unreadable(self._name, code)
                known = BY_CODE[code]
                pixels = _pixels(buffer, known)
            return Frame(
                known.blank(self._width, self._height) if pixels is None else pixels,
                known.bit_depth,
                int(buffer.get_frame_id()),
                # a camera without a clock of its own gives zero
                int(buffer.get_timestamp()) or host_ns,
                host_ns,
                FrameStatus.INCOMPLETE if pixels is None else FrameStatus.OK,
            )
        finally:
            _give_back(stream, buffer)

    def statistics(self) -> dict[str, int | float]:
        """Return Aravis' counters; does not ask the camera."""
        counts: dict[str, int | float] = {"headerless_frames": self.headerless}
        with self._in_use(even_ended=True) as stream:
            if stream is not None:
                for index in range(stream.get_n_infos()):
                    ours = _INFOS.get(stream.get_info_name(index))
                    if ours is not None:
                        counts[ours] = int(stream.get_info_uint64(index))
                for ours, number in zip(_PRESENT, stream.get_n_buffers(), strict=True):
                    counts[ours] = int(number)
            del stream
        return counts

    def end(self) -> None:
        """Let waits end."""
        with self._changed:
            self._ended = True

    def release(self) -> dict[str, int | float]:
        """End the receiving thread, free the buffers and return the last counts.

        Waits 2.5 s for a camera that is gone.
        """
        counts = self.statistics()
        with self._changed:
            self._ended = True
            self._changed.wait_for(lambda: self._users == 0)
            stream, self._stream = self._stream, None
        del stream
        return {name: count for name, count in counts.items() if name not in _PRESENT}


def _give_back(stream: Any, buffer: Any) -> None:
    # a frame that comes without its header would have the number and times of the last in this buffer
    buffer.set_frame_id(0)
    buffer.set_timestamp(0)
    buffer.set_system_timestamp(0)
    stream.push_buffer(buffer)


def _pixels(buffer: Any, pixel_format: PixelFormat) -> Pixels | None:
    """Return the image in a complete buffer; None when it is too short after all."""
    width, height = int(buffer.get_image_width()), int(buffer.get_image_height())
    if buffer.get_payload_type() == aravis().BufferPayloadType.MULTIPART:
        data = np.frombuffer(buffer.get_image_data(), np.uint8)
    else:
        data = buffer_bytes(buffer)
    # packets larger than Aravis takes arrive cut off, in buffers that it calls complete
    if min(width, height) < 1 or len(data) < pixel_format.size_bytes(width * height):
        return None
    try:
        return unpack(data, pixel_format, width, height, line_padding_bytes=int(buffer.get_image_padding()[0]))
    except CameraError:  # too short for its padded lines
        return None
