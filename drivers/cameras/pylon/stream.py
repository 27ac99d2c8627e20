"""The frames of one armed camera, and pylon's counters of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.errors import unreadable
from stereorig.drivers.cameras.pixels import BY_CODE, PixelFormat, unpack
from stereorig.drivers.cameras.protocol import Frame, FrameStatus
from stereorig.drivers.cameras.pylon.device import PylonDevice
from stereorig.drivers.cameras.pylon.library import genapi, pylon

# a cut-off wait and a camera that is gone are noticed this often
_SLICE_S = 0.02
_NO_NUMBER = 2**64 - 1
#: pylon's count -> ours
_COUNTS = {
    "Statistic_Total_Buffer_Count": "completed_buffers",
    "Statistic_Failed_Buffer_Count": "failed_buffers",
    "Statistic_Buffer_Underrun_Count": "underruns",
    "Statistic_Missed_Frame_Count": "missing_frames",
    "Statistic_Total_Packet_Count": "received_packets",
    "Statistic_Failed_Packet_Count": "missing_packets",
    "Statistic_Resend_Request_Count": "resend_requests",
    "Statistic_Resend_Packet_Count": "resent_packets",
}


class PylonStream:
    """Frames of a camera from arming to disarming.

    pylon does not stamp a frame's arrival: it is the moment at which the frame is taken, so frames must be waited for.

    Parameters
    ----------
    device
        The camera, connected.
    region_px, pixel_format
        Present settings of the camera, for frames that are not whole.
    ticks_per_s
        Ticks of the camera's clock.
    on_lost
        Called with the reason when the camera is gone.
    """

    def __init__(
        self,
        device: PylonDevice,
        region_px: tuple[int, int, int, int],
        pixel_format: PixelFormat,
        ticks_per_s: int,
        on_lost: Callable[[str], None],
    ) -> None:
        self._device = device
        self._width, self._height = region_px[2:]
        self._format = pixel_format
        self._ticks_per_s = ticks_per_s
        self._on_lost = on_lost
        self._taking = threading.Lock()
        self._ended = False
        self._counts: dict[str, int | float] = {}
        self.headerless = 0  # frames whose number is not known

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for a frame; ends early, with None, when the stream is ended or the camera is gone."""
        deadline = time.monotonic() + timeout_s
        while not self._ended:
            left = deadline - time.monotonic()
            # held for a slice only: `release` waits for it
            with self._taking, self._device.asked() as camera:
                if self._device.removed:
                    self._on_lost("was unplugged or switched off")
                    return None
                wait_ms = round(1000 * max(0.0, min(left, _SLICE_S)))
                result = camera.RetrieveResult(wait_ms, pylon().TimeoutHandling_Return)
                try:
                    frame = self._frame(result) if result.IsValid() else None
                    grabs = bool(camera.IsGrabbing())
                finally:
                    result.Release()
            if frame is not None or left <= 0:
                return frame
            if not grabs:
                time.sleep(min(left, _SLICE_S))  # else the wait returns at once
        return None

    def _frame(self, result: Any) -> Frame | None:
        host_ns = time.monotonic_ns()
        number = int(result.GetBlockID())
        if number == _NO_NUMBER:
            self.headerless += 1
            return None
        known, pixels = self._format, None
        if result.GrabSucceeded():
            code = int(result.GetPixelType())
            if code not in BY_CODE:
                raise unreadable(self._device.name, code)
            known = BY_CODE[code]
            data = np.frombuffer(result.GetMemoryView(), np.uint8)
            size = int(result.GetWidth()), int(result.GetHeight())
            pixels = unpack(data, known, *size, line_padding_bytes=int(result.GetPaddingX()))
            del data
        ticks = int(result.GetTimeStamp())
        return Frame(
            known.blank(self._width, self._height) if pixels is None else pixels,
            known.bit_depth,
            number,
            # a camera without a clock of its own gives zero
            ticks * 10**9 // self._ticks_per_s or host_ns,
            host_ns,
            FrameStatus.INCOMPLETE if pixels is None else FrameStatus.OK,
        )

    def statistics(self) -> dict[str, int | float]:
        """Return pylon's counters; does not ask the camera."""
        counts: dict[str, int | float] = {"headerless_frames": self.headerless}
        if self._ended:
            return counts | self._counts
        with self._device.asked(ended=True) as camera:
            known = camera.GetStreamGrabberNodeMap()
            for theirs, ours in _COUNTS.items():
                node = known.GetNode(theirs)
                if node is not None and genapi().IsReadable(node):
                    counts[ours] = int(node.GetValue())
        return counts

    def end(self) -> None:
        """Let waits end."""
        if not self._ended:
            try:
                self._counts = self.statistics()
            except CameraError:  # a camera that is gone has no counters any more
                self._counts = {}
            self._ended = True

    def release(self) -> dict[str, int | float]:
        """Wait until no frame is being taken, and return the last counts."""
        self.end()
        with self._taking:
            return self.statistics()
