"""Frames from the kernel's ring of buffers, which are mapped into memory and given back as soon as they were read."""

from __future__ import annotations

import ctypes
import errno
import mmap
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import Frame, FrameStatus
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.device import V4l2Device
from stereorig.drivers.cameras.v4l2.picture import FrameLayout, PictureFormat

# A stamp of the monotonic clock that differs from the frame's arrival by more than this is wrong
_ODD_STAMP_NS = 1_000_000_000
_BUSY_S = 0.2


@dataclass
class Counts:
    """Counters of the buffers since the camera was opened."""

    buffers: int = 0  # in the ring now
    frames: int = 0  # taken out
    errors: int = 0  # marked damaged by the device
    short: int = 0  # with fewer bytes than an image has
    not_requeued: int = 0  # refused when given back; tried again with the next frame
    odd_stamps: int = 0  # more than a second from their arrival


def _new_buffer(picture: PictureFormat, index: int) -> v.Buffer:
    buffer = v.Buffer(index=index, type=picture.buffer_type, memory=v.MEMORY_MMAP)
    if picture.planar:
        planes = (v.Plane * v.VIDEO_MAX_PLANES)()
        buffer.length = v.VIDEO_MAX_PLANES
        buffer.m.planes = ctypes.cast(planes, ctypes.POINTER(v.Plane))  # keeps the array alive
    return buffer


def _request(device: V4l2Device, picture: PictureFormat, count: int) -> int:
    """Ask for buffers and return their number; waits a moment for a short user of the device, such as `discover`."""
    end = time.monotonic() + _BUSY_S
    while True:
        request = v.RequestBuffers(count, picture.buffer_type, v.MEMORY_MMAP)
        try:
            device.ioctl(v.VIDIOC_REQBUFS, request)
        except OSError as error:
            if error.errno != errno.EBUSY or time.monotonic() >= end:
                raise
            time.sleep(0.02)
        else:
            return request.count


def probe_flags(device: V4l2Device, picture: PictureFormat) -> int:
    """Ask for a buffer and give it back; return the clock of the frames' stamps, or raise if another program streams.

    Raises
    ------
    CameraError
        ``camera_busy``, ``camera_lost``.
    """
    buffer = _new_buffer(picture, 0)
    try:
        _request(device, picture, 1)
        try:
            device.ioctl(v.VIDIOC_QUERYBUF, buffer)
        finally:
            device.ioctl(v.VIDIOC_REQBUFS, v.RequestBuffers(0, picture.buffer_type, v.MEMORY_MMAP))
    except OSError as error:
        if error.errno in (errno.EBUSY, errno.ENODEV, errno.ENXIO, errno.EIO):
            raise device.fault(error, "stream") from error
        return 0  # not with its present format; arming raises the reason
    return buffer.flags


def clock_of(flags: int) -> str:
    """Name of the clock that stamps buffers with these flags; empty when it is not the host's monotonic one."""
    return "monotonic" if flags & v.BUF_FLAG_TIMESTAMP_MASK == v.BUF_FLAG_TIMESTAMP_MONOTONIC else ""


def stamped_at(flags: int) -> str:
    """Return the event of the stamp: the start of the exposure, or the end of the frame's last line."""
    return "start of exposure" if flags & v.BUF_FLAG_TSTAMP_SRC_MASK == v.BUF_FLAG_TSTAMP_SRC_SOE else "end of frame"


def stamp_error_ms(flags: int) -> float:
    """Largest error of such a stamp: an interrupt's delay; at the end of a frame, the steps of USB's frames too."""
    return 0.1 if flags & v.BUF_FLAG_TSTAMP_SRC_MASK == v.BUF_FLAG_TSTAMP_SRC_SOE else 1.0


class Stream:
    """A running stream of one layout; `stop` may come while another thread is in `take`."""

    def __init__(
        self, device: V4l2Device, picture: PictureFormat, layout: FrameLayout, buffers: int, counts: Counts
    ) -> None:
        self._device = device
        self._picture = picture
        self._layout = layout
        self._gray = picture.require_readable(layout)
        self._stride = layout.stride or self._gray.row_bytes(layout.width)
        self._counts = counts
        self._lock = threading.Lock()
        self._maps: list[mmap.mmap] = []
        self._idle: list[int] = []
        self.running = False
        try:
            count = _request(device, picture, min(max(buffers, 2), v.VIDEO_MAX_FRAME))
            for index in range(count):
                self._maps.append(self._mapped(index))
                device.ioctl(v.VIDIOC_QBUF, _new_buffer(picture, index))
            device.ioctl(v.VIDIOC_STREAMON, ctypes.c_int(picture.buffer_type))
        except OSError as error:
            self.stop()
            raise device.fault(error, "start its stream") from error
        except CameraError:
            self.stop()
            raise
        counts.buffers = count
        self.running = True

    def _mapped(self, index: int) -> mmap.mmap:
        buffer = _new_buffer(self._picture, index)
        self._device.ioctl(v.VIDIOC_QUERYBUF, buffer)
        offset, length = buffer.m.offset, buffer.length
        if self._picture.planar:
            # brightness is in the first plane, which alone is mapped
            offset, length = buffer.m.planes[0].m.mem_offset, buffer.m.planes[0].length
        layout = self._layout
        if length < self._gray.image_bytes(layout.width, layout.height, self._stride):
            raise CameraError(
                f"{self._device.path} gives buffers of {length} bytes, too small for "
                f"{layout.width} x {layout.height} px of {self._gray.name.strip()}.",
                code="frame_format",
                remedy="Choose another pixel_format or size.",
                device=self._device.path,
            )
        return mmap.mmap(self._device.fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def take(self) -> Frame | None:
        """Take the oldest finished frame; ``None`` when there is none, or the stream was stopped.

        Raises
        ------
        CameraError
            ``camera_lost`` when the device is gone or its stream broke; ``frame_format`` when its pixels are not of the
            stated format.
        """
        with self._lock:
            if not self.running:
                return None
            self._requeue()
            buffer = _new_buffer(self._picture, 0)
            try:
                self._device.ioctl(v.VIDIOC_DQBUF, buffer)
            except BlockingIOError:
                return None
            except OSError as error:
                raise self._broken(error) from error
            host_ns = time.monotonic_ns()
            self._idle.append(buffer.index)
            try:
                return self._frame(buffer, host_ns)
            finally:
                # an error of the kernel now must not lose the frame that is already here
                with suppress(CameraError):
                    self._requeue()

    def _requeue(self) -> None:
        for index in self._idle[:]:
            try:
                self._device.ioctl(v.VIDIOC_QBUF, _new_buffer(self._picture, index))
            except OSError as error:
                self._counts.not_requeued += 1
                if error.errno in (errno.ENODEV, errno.ENXIO, errno.EIO) or len(self._idle) == len(self._maps):
                    raise self._broken(error) from error
            else:
                self._idle.remove(index)

    def _broken(self, error: OSError) -> CameraError:
        fault = self._device.fault(error, "deliver frames")
        if fault.code == "camera_fault":  # in any case, no frame will come from this stream any more
            fault.code = "camera_lost"
        return fault

    def _frame(self, buffer: v.Buffer, host_ns: int) -> Frame:
        layout, gray, counts = self._layout, self._gray, self._counts
        begin, used = 0, buffer.bytesused
        if self._picture.planar:
            plane = buffer.m.planes[0]
            begin, used = plane.data_offset, plane.bytesused - plane.data_offset
        counts.frames += 1
        status = FrameStatus.OK
        if buffer.flags & v.BUF_FLAG_ERROR:
            counts.errors += 1
            status = FrameStatus.INCOMPLETE
        memory = np.frombuffer(self._maps[buffer.index], np.uint8)[begin:]
        needed = gray.image_bytes(layout.width, layout.height, self._stride)
        if min(used, memory.size) < needed:
            counts.short += 1
            status = FrameStatus.INCOMPLETE
        stamp_ns = buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1000
        if stamp_ns and clock_of(buffer.flags) and abs(host_ns - stamp_ns) > _ODD_STAMP_NS:
            counts.odd_stamps += 1
        if memory.size < needed:
            memory = np.zeros(needed, np.uint8)
        pixels = gray.pixels(memory, layout.width, layout.height, self._stride)
        if status is not FrameStatus.OK:
            # missing lines still show an older frame
            pixels[max(used, 0) // self._stride :] = 0
        elif pixels.dtype == np.uint16 and gray.bit_depth < 16 and int(pixels.max()) >= 1 << gray.bit_depth:
            raise CameraError(
                f"{self._device.path} says {gray.name.strip()} and sends values up to {int(pixels.max())}, more than "
                f"{gray.bit_depth} bits hold.",
                code="frame_format",
                remedy="Its driver breaks the format's definition; choose another pixel_format.",
                device=self._device.path,
            )
        return Frame(pixels, gray.bit_depth, buffer.sequence, stamp_ns, host_ns, status)

    def stop(self) -> None:
        """Stop and give the buffers back; safe to call twice."""
        with self._lock:
            self.running = False
            for one in self._maps:
                # after an error the pixels may still be in use: the mapping then ends with the last user
                with suppress(BufferError):
                    one.close()
            self._maps.clear()
            self._picture.stop()
            self._counts.buffers = 0
