"""Picture of a device: pixel format, size, region and rate, tried before they are set and read back after.

The kernel changes impossible values into possible ones without an error. All values are therefore compared with the
requested ones.
"""

from __future__ import annotations

import ctypes
import errno
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.device import V4l2Device
from stereorig.drivers.cameras.v4l2.formats import BY_CODE, GRAY_FORMATS, GrayFormat, fourcc_name

Region = tuple[int, int, int, int]
_Entry = TypeVar("_Entry", v.FmtDesc, v.FrmSizeEnum, v.FrmIvalEnum)

# Answers of a driver that does not know a request, or not for this format or input
_NOT_HERE = (errno.EINVAL, errno.ENOTTY, errno.ENODATA)
# A rate that was printed with six digits must be taken back
_RATE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class FrameLayout:
    """Layout of one frame in memory."""

    code: int
    width: int
    height: int
    stride: int
    planes: int
    field: int
    quantization: int

    @property
    def gray(self) -> GrayFormat | None:
        """Its reader; ``None`` for formats without a brightness of their own."""
        return BY_CODE.get(self.code)


@dataclass(frozen=True)
class Rates:
    """Frame rates of one format and size, in Hz; ``single`` when only certain ones can be had."""

    lowest: float
    highest: float
    single: tuple[Fraction, ...] = ()

    def holds(self, rate_hz: float) -> bool:
        """Return True if a rate is in the range; the device may round it inside."""
        return self.lowest * (1 - _RATE_TOLERANCE) <= rate_hz <= self.highest * (1 + _RATE_TOLERANCE)


class PictureFormat:
    """Format, region and rate of one device."""

    def __init__(self, device: V4l2Device) -> None:
        self._device = device
        self._origin = (0, 0)
        self.planar = bool(device.capabilities & v.CAP_VIDEO_CAPTURE_MPLANE)
        self.buffer_type = v.BUF_TYPE_VIDEO_CAPTURE_MPLANE if self.planar else v.BUF_TYPE_VIDEO_CAPTURE
        self.codes = tuple(
            entry.pixelformat for entry in self._list(v.VIDIOC_ENUM_FMT, v.FmtDesc(type=self.buffer_type))
        )

    def _list(self, request: int, entry: _Entry) -> Iterator[_Entry]:
        for index in range(4096):  # bounded: a driver may never report the last one
            entry.index = index
            try:
                self._device.ioctl(request, entry)
            except OSError as error:
                if error.errno in _NOT_HERE:
                    return
                raise self._device.fault(error, "list its formats") from error
            yield entry

    @property
    def gray_formats(self) -> tuple[GrayFormat, ...]:
        """Readable formats of the device, the plainest first."""
        return tuple(known for known in GRAY_FORMATS if known.code in self.codes)

    def other_formats(self) -> tuple[str, ...]:
        """Names of the formats that cannot be read."""
        return tuple(fourcc_name(code) for code in self.codes if code not in BY_CODE)

    def layout(self) -> FrameLayout:
        """Read the present format."""
        return self._layout(self._format(v.VIDIOC_G_FMT, v.Format(type=self.buffer_type), "say its format"))

    def _format(self, request: int, wanted: v.Format, action: str) -> v.Format:
        try:
            self._device.ioctl(request, wanted)
        except OSError as error:
            raise self._device.fault(error, action) from error
        return wanted

    def _layout(self, answer: v.Format) -> FrameLayout:
        if self.planar:
            many = answer.fmt.pix_mp
            return FrameLayout(
                code=many.pixelformat,
                width=many.width,
                height=many.height,
                stride=many.plane_fmt[0].bytesperline,
                planes=many.num_planes,
                field=many.field,
                quantization=many.quantization,
            )
        one = answer.fmt.pix
        return FrameLayout(
            code=one.pixelformat,
            width=one.width,
            height=one.height,
            stride=one.bytesperline,
            planes=1,
            field=one.field,
            quantization=one.quantization,
        )

    def _asking(self, code: int, width: int, height: int) -> v.Format:
        wanted = v.Format(type=self.buffer_type)
        if self.planar:
            many = wanted.fmt.pix_mp
            many.pixelformat, many.width, many.height, many.field = code, width, height, v.FIELD_NONE
        else:
            one = wanted.fmt.pix
            one.pixelformat, one.width, one.height, one.field = code, width, height, v.FIELD_NONE
        return wanted

    def tried(self, code: int, width: int, height: int) -> FrameLayout:
        """Return the format that the device would take, without setting it."""
        return self._layout(self._format(v.VIDIOC_TRY_FMT, self._asking(code, width, height), "try a format"))

    def set(self, code: int, width: int, height: int) -> FrameLayout:
        """Set a format and return the one that the device took."""
        return self._layout(self._format(v.VIDIOC_S_FMT, self._asking(code, width, height), "set its format"))

    def sizes(self, code: int) -> str:
        """Sizes that a format comes in, as a text; empty if the device does not list them."""
        found: list[str] = []
        for entry in self._list(v.VIDIOC_ENUM_FRAMESIZES, v.FrmSizeEnum(pixel_format=code)):
            if entry.type == v.FRMSIZE_TYPE_DISCRETE:
                found.append(f"{entry.u.discrete.width} x {entry.u.discrete.height}")
            else:
                s = entry.u.stepwise
                steps = f" in steps of {s.step_width} x {s.step_height}" if max(s.step_width, s.step_height) > 1 else ""
                return f"{s.min_width} x {s.min_height} to {s.max_width} x {s.max_height}{steps}"
        return ", ".join(found)

    def rates(self, code: int, width: int, height: int) -> Rates | None:
        """Frame rates of a format and size; ``None`` if the device does not list them."""
        single: list[Fraction] = []
        for entry in self._list(
            v.VIDIOC_ENUM_FRAMEINTERVALS, v.FrmIvalEnum(pixel_format=code, width=width, height=height)
        ):
            if entry.type == v.FRMIVAL_TYPE_DISCRETE:
                single.append(_seconds(entry.u.discrete))
            else:
                shortest, longest = _seconds(entry.u.stepwise.min), _seconds(entry.u.stepwise.max)
                if not (shortest and longest):
                    return None
                return Rates(float(1 / longest), float(1 / shortest))
        single = sorted(period for period in single if period)
        return Rates(float(1 / single[-1]), float(1 / single[0]), tuple(single)) if single else None

    def period(self) -> Fraction | None:
        """Time from frame to frame in s; ``None`` if the device does not report it or has no such setting."""
        parm = self._parm()
        if parm is None:
            return None
        return _seconds(parm.parm.capture.timeperframe) or None

    def _parm(self) -> v.StreamParm | None:
        parm = v.StreamParm(type=self.buffer_type)
        try:
            self._device.ioctl(v.VIDIOC_G_PARM, parm)
        except OSError as error:
            if error.errno in _NOT_HERE:
                return None
            raise self._device.fault(error, "say its frame rate") from error
        return parm if parm.parm.capture.capability & v.CAP_TIMEPERFRAME else None

    @property
    def has_rate(self) -> bool:
        """True if the frame rate can be set."""
        return self._parm() is not None

    def set_rate(self, rate_hz: float, rates: Rates | None) -> None:
        """Set a rate; `period` returns the one taken."""
        period = Fraction(1 / rate_hz).limit_denominator(1_000_000)
        if rates is not None and rates.single:
            period = min(rates.single, key=lambda one: abs(float(1 / one) - rate_hz))
        parm = v.StreamParm(type=self.buffer_type)
        parm.parm.capture.timeperframe = v.Fract(period.numerator, period.denominator)
        try:
            self._device.ioctl(v.VIDIOC_S_PARM, parm)
        except OSError as error:
            raise self._device.fault(error, f"run at {rate_hz:g} Hz") from error

    def bounds(self) -> tuple[int, int] | None:
        """Width and height that a region may be cut out of; ``None`` if the device cannot cut one."""
        present = self._selection(v.SEL_TGT_CROP)
        bounds = self._selection(v.SEL_TGT_CROP_BOUNDS)
        if present is None or bounds is None or min(bounds[2:]) < 1:
            return None
        before = self.layout()
        try:  # many devices report a rectangle that they cannot change
            self._cut(present)
        except OSError as error:
            if error.errno != errno.EBUSY:
                return None
        if self.layout() != before:  # some change their format with each rectangle
            self.set(before.code, before.width, before.height)
        self._origin = bounds[0], bounds[1]
        return bounds[2], bounds[3]

    def crop(self) -> Region | None:
        """Return the present rectangle, from the corner of the bounds."""
        here = self._selection(v.SEL_TGT_CROP)
        return None if here is None else (here[0] - self._origin[0], here[1] - self._origin[1], here[2], here[3])

    def cut(self, region: Region) -> Region | None:
        """Set the rectangle and return the one that the device took."""
        try:
            self._cut((region[0] + self._origin[0], region[1] + self._origin[1], region[2], region[3]))
        except OSError as error:
            if error.errno in (*_NOT_HERE, errno.ERANGE):
                return self.crop()
            raise self._device.fault(error, "cut out a region") from error
        return self.crop()

    def _cut(self, region: Region) -> None:
        self._device.ioctl(
            v.VIDIOC_S_SELECTION, v.Selection(type=v.BUF_TYPE_VIDEO_CAPTURE, target=v.SEL_TGT_CROP, r=v.Rect(*region))
        )

    def _selection(self, target: int) -> Region | None:
        here = v.Selection(type=v.BUF_TYPE_VIDEO_CAPTURE, target=target)
        try:
            self._device.ioctl(v.VIDIOC_G_SELECTION, here)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.ENXIO):
                raise self._device.fault(error, "say its region") from error
            return None
        return here.r.left, here.r.top, here.r.width, here.r.height

    def stop(self) -> None:
        """Stop the stream and give its buffers back; a device that is gone has stopped."""
        with suppress(OSError):
            self._device.ioctl(v.VIDIOC_STREAMOFF, ctypes.c_int(self.buffer_type))
        with suppress(OSError):
            self._device.ioctl(v.VIDIOC_REQBUFS, v.RequestBuffers(0, self.buffer_type, v.MEMORY_MMAP))

    def require_readable(self, layout: FrameLayout) -> GrayFormat:
        """Return the reader of a format; code ``frame_format`` when there is none."""
        path = self._device.path
        gray = layout.gray
        if gray is None:
            known = ", ".join(known.name.strip() for known in self.gray_formats)
            raise CameraError(
                f"{path} sends {fourcc_name(layout.code)!r}, which is no plain brightness.",
                code="frame_format",
                remedy=f"Set pixel_format to one of: {known}." if known else "Use a camera with a gray or YUV format.",
                device=path,
            )
        if layout.field not in (v.FIELD_ANY, v.FIELD_NONE):
            raise CameraError(
                f"{path} sends interlaced pictures: its odd and even lines were taken at different times.",
                code="frame_format",
                remedy="Switch the camera or its input to a progressive mode.",
                device=path,
            )
        min_stride = gray.row_bytes(layout.width)
        if 0 < layout.stride < min_stride:
            raise CameraError(
                f"{path} says that a line of {layout.width} px in {gray.name.strip()} has {layout.stride} bytes; "
                f"it needs {min_stride}.",
                code="frame_format",
                remedy="Choose another pixel_format or a width that is a multiple of 50 px.",
                device=path,
            )
        return gray


def _seconds(period: v.Fract) -> Fraction:
    return Fraction(period.numerator, period.denominator) if period.numerator and period.denominator else Fraction(0)
