"""The kernel's V4L2 structures and request numbers, as ``linux/videodev2.h`` lays them out.

Only the parts that the driver uses. Names are the header's, in Python's spelling; their meanings are in the header's
comments and the kernel's documentation. Sizes and offsets are checked against the header by a C program in the tests.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int32, c_int64, c_long, c_size_t, c_ubyte, c_uint8, c_uint16, c_uint32, c_uint64, c_void_p

u8, u16, u32, u64, s32, s64 = c_uint8, c_uint16, c_uint32, c_uint64, c_int32, c_int64

BUF_TYPE_VIDEO_CAPTURE = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE = 9
MEMORY_MMAP = 1
VIDEO_MAX_FRAME = 32
VIDEO_MAX_PLANES = 8

CAP_VIDEO_CAPTURE = 0x0000_0001
CAP_VIDEO_CAPTURE_MPLANE = 0x0000_1000
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000
CAP_TIMEPERFRAME = 0x1000

FIELD_ANY = 0
FIELD_NONE = 1

BUF_FLAG_ERROR = 0x0000_0040
BUF_FLAG_TIMESTAMP_MASK = 0x0000_E000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x0000_2000
BUF_FLAG_TSTAMP_SRC_MASK = 0x0007_0000
BUF_FLAG_TSTAMP_SRC_SOE = 0x0001_0000

FRMSIZE_TYPE_DISCRETE = 1
FRMIVAL_TYPE_DISCRETE = 1

SEL_TGT_CROP = 0x0000
SEL_TGT_CROP_BOUNDS = 0x0002

CTRL_TYPE_INTEGER = 1
CTRL_TYPE_BOOLEAN = 2
CTRL_TYPE_MENU = 3
CTRL_TYPE_BUTTON = 4
CTRL_TYPE_INTEGER64 = 5
CTRL_TYPE_STRING = 7
CTRL_TYPE_BITMASK = 8
CTRL_TYPE_INTEGER_MENU = 9

CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_READ_ONLY = 0x0004
CTRL_FLAG_INACTIVE = 0x0010
CTRL_FLAG_WRITE_ONLY = 0x0040
CTRL_FLAG_VOLATILE = 0x0080
CTRL_FLAG_NEXT_CTRL = 0x8000_0000
CTRL_WHICH_CUR_VAL = 0

CID_EXPOSURE_AUTO = 0x009A_0901
CID_EXPOSURE_ABSOLUTE = 0x009A_0902
EXPOSURE_MANUAL = 1
EXPOSURE_SHUTTER_PRIORITY = 2

QUANTIZATION_FULL_RANGE = 1


class Capability(ctypes.Structure):
    """``struct v4l2_capability``."""

    driver: bytes
    card: bytes
    bus_info: bytes
    version: int
    capabilities: int
    device_caps: int
    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", u32),
        ("capabilities", u32),
        ("device_caps", u32),
        ("reserved", u32 * 3),
    )


class FmtDesc(ctypes.Structure):
    """``struct v4l2_fmtdesc``."""

    index: int
    type: int
    flags: int
    description: bytes
    pixelformat: int
    _fields_ = (
        ("index", u32),
        ("type", u32),
        ("flags", u32),
        ("description", c_char * 32),
        ("pixelformat", u32),
        ("mbus_code", u32),
        ("reserved", u32 * 3),
    )


class Size(ctypes.Structure):
    """``struct v4l2_frmsize_discrete``."""

    width: int
    height: int
    _fields_ = (("width", u32), ("height", u32))


class SizeSteps(ctypes.Structure):
    """``struct v4l2_frmsize_stepwise``."""

    min_width: int
    max_width: int
    step_width: int
    min_height: int
    max_height: int
    step_height: int
    _fields_ = (
        ("min_width", u32),
        ("max_width", u32),
        ("step_width", u32),
        ("min_height", u32),
        ("max_height", u32),
        ("step_height", u32),
    )


class _SizeUnion(ctypes.Union):
    discrete: Size
    stepwise: SizeSteps
    _fields_ = (("discrete", Size), ("stepwise", SizeSteps))


class FrmSizeEnum(ctypes.Structure):
    """``struct v4l2_frmsizeenum``."""

    index: int
    pixel_format: int
    type: int
    u: _SizeUnion
    _fields_ = (("index", u32), ("pixel_format", u32), ("type", u32), ("u", _SizeUnion), ("reserved", u32 * 2))


class Fract(ctypes.Structure):
    """``struct v4l2_fract``."""

    numerator: int
    denominator: int
    _fields_ = (("numerator", u32), ("denominator", u32))


class IntervalSteps(ctypes.Structure):
    """``struct v4l2_frmival_stepwise``."""

    min: Fract
    max: Fract
    step: Fract
    _fields_ = (("min", Fract), ("max", Fract), ("step", Fract))


class _IntervalUnion(ctypes.Union):
    discrete: Fract
    stepwise: IntervalSteps
    _fields_ = (("discrete", Fract), ("stepwise", IntervalSteps))


class FrmIvalEnum(ctypes.Structure):
    """``struct v4l2_frmivalenum``."""

    index: int
    pixel_format: int
    width: int
    height: int
    type: int
    u: _IntervalUnion
    _fields_ = (
        ("index", u32),
        ("pixel_format", u32),
        ("width", u32),
        ("height", u32),
        ("type", u32),
        ("u", _IntervalUnion),
        ("reserved", u32 * 2),
    )


class PixFormat(ctypes.Structure):
    """``struct v4l2_pix_format``."""

    width: int
    height: int
    pixelformat: int
    field: int
    bytesperline: int
    sizeimage: int
    quantization: int
    _fields_ = (
        ("width", u32),
        ("height", u32),
        ("pixelformat", u32),
        ("field", u32),
        ("bytesperline", u32),
        ("sizeimage", u32),
        ("colorspace", u32),
        ("priv", u32),
        ("flags", u32),
        ("ycbcr_enc", u32),
        ("quantization", u32),
        ("xfer_func", u32),
    )


class PlanePixFormat(ctypes.Structure):
    """``struct v4l2_plane_pix_format``."""

    sizeimage: int
    bytesperline: int
    _pack_ = 1
    _fields_ = (("sizeimage", u32), ("bytesperline", u32), ("reserved", u16 * 6))


class PixFormatMplane(ctypes.Structure):
    """``struct v4l2_pix_format_mplane``."""

    width: int
    height: int
    pixelformat: int
    field: int
    plane_fmt: ctypes.Array[PlanePixFormat]
    num_planes: int
    quantization: int
    _pack_ = 1
    _fields_ = (
        ("width", u32),
        ("height", u32),
        ("pixelformat", u32),
        ("field", u32),
        ("colorspace", u32),
        ("plane_fmt", PlanePixFormat * VIDEO_MAX_PLANES),
        ("num_planes", u8),
        ("flags", u8),
        ("ycbcr_enc", u8),
        ("quantization", u8),
        ("xfer_func", u8),
        ("reserved", u8 * 7),
    )


class _FormatUnion(ctypes.Union):
    pix: PixFormat
    pix_mp: PixFormatMplane
    # the header's union also holds a struct with pointers, which sets its alignment
    _fields_ = (("pix", PixFormat), ("pix_mp", PixFormatMplane), ("pointer", c_void_p), ("raw", c_ubyte * 200))


class Format(ctypes.Structure):
    """``struct v4l2_format``."""

    type: int
    fmt: _FormatUnion
    _fields_ = (("type", u32), ("fmt", _FormatUnion))


class CaptureParm(ctypes.Structure):
    """``struct v4l2_captureparm``."""

    capability: int
    timeperframe: Fract
    _fields_ = (
        ("capability", u32),
        ("capturemode", u32),
        ("timeperframe", Fract),
        ("extendedmode", u32),
        ("readbuffers", u32),
        ("reserved", u32 * 4),
    )


class _ParmUnion(ctypes.Union):
    capture: CaptureParm
    _fields_ = (("capture", CaptureParm), ("raw", c_ubyte * 200))


class StreamParm(ctypes.Structure):
    """``struct v4l2_streamparm``."""

    type: int
    parm: _ParmUnion
    _fields_ = (("type", u32), ("parm", _ParmUnion))


class Rect(ctypes.Structure):
    """``struct v4l2_rect``."""

    left: int
    top: int
    width: int
    height: int
    _fields_ = (("left", s32), ("top", s32), ("width", u32), ("height", u32))


class Selection(ctypes.Structure):
    """``struct v4l2_selection``."""

    type: int
    target: int
    flags: int
    r: Rect
    _fields_ = (("type", u32), ("target", u32), ("flags", u32), ("r", Rect), ("reserved", u32 * 9))


class RequestBuffers(ctypes.Structure):
    """``struct v4l2_requestbuffers``."""

    count: int
    type: int
    memory: int
    _fields_ = (
        ("count", u32),
        ("type", u32),
        ("memory", u32),
        ("capabilities", u32),
        ("flags", u8),
        ("reserved", u8 * 3),
    )


class _PlaneMemory(ctypes.Union):
    mem_offset: int
    _fields_ = (("mem_offset", u32), ("userptr", c_size_t), ("fd", s32))


class Plane(ctypes.Structure):
    """``struct v4l2_plane``."""

    bytesused: int
    length: int
    m: _PlaneMemory
    data_offset: int
    _fields_ = (("bytesused", u32), ("length", u32), ("m", _PlaneMemory), ("data_offset", u32), ("reserved", u32 * 11))


class TimeVal(ctypes.Structure):
    """``struct timeval``."""

    tv_sec: int
    tv_usec: int
    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class TimeCode(ctypes.Structure):
    """``struct v4l2_timecode``."""

    _fields_ = (
        ("type", u32),
        ("flags", u32),
        ("frames", u8),
        ("seconds", u8),
        ("minutes", u8),
        ("hours", u8),
        ("userbits", u8 * 4),
    )


class _BufferMemory(ctypes.Union):
    offset: int
    planes: ctypes._Pointer[Plane]
    _fields_ = (("offset", u32), ("userptr", c_size_t), ("planes", ctypes.POINTER(Plane)), ("fd", s32))


class Buffer(ctypes.Structure):
    """``struct v4l2_buffer``."""

    index: int
    type: int
    bytesused: int
    flags: int
    timestamp: TimeVal
    sequence: int
    memory: int
    m: _BufferMemory
    length: int
    _fields_ = (
        ("index", u32),
        ("type", u32),
        ("bytesused", u32),
        ("flags", u32),
        ("field", u32),
        ("timestamp", TimeVal),
        ("timecode", TimeCode),
        ("sequence", u32),
        ("memory", u32),
        ("m", _BufferMemory),
        ("length", u32),
        ("reserved2", u32),
        ("request_fd", s32),
    )


class QueryExtCtrl(ctypes.Structure):
    """``struct v4l2_query_ext_ctrl``."""

    id: int
    type: int
    name: bytes
    minimum: int
    maximum: int
    step: int
    default_value: int
    flags: int
    elem_size: int
    _fields_ = (
        ("id", u32),
        ("type", u32),
        ("name", c_char * 32),
        ("minimum", s64),
        ("maximum", s64),
        ("step", u64),
        ("default_value", s64),
        ("flags", u32),
        ("elem_size", u32),
        ("elems", u32),
        ("nr_of_dims", u32),
        ("dims", u32 * 4),
        ("reserved", u32 * 32),
    )


class _MenuUnion(ctypes.Union):
    name: bytes
    value: int
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", s64))


class QueryMenu(ctypes.Structure):
    """``struct v4l2_querymenu``."""

    id: int
    index: int
    u: _MenuUnion
    _pack_ = 1
    _fields_ = (("id", u32), ("index", u32), ("u", _MenuUnion), ("reserved", u32))


class _ControlUnion(ctypes.Union):
    value: int
    value64: int
    string: int | None
    _pack_ = 1
    _fields_ = (("value", s32), ("value64", s64), ("string", c_void_p))


class ExtControl(ctypes.Structure):
    """``struct v4l2_ext_control``."""

    id: int
    size: int
    u: _ControlUnion
    _pack_ = 1
    _fields_ = (("id", u32), ("size", u32), ("reserved2", u32), ("u", _ControlUnion))


class ExtControls(ctypes.Structure):
    """``struct v4l2_ext_controls``."""

    which: int
    count: int
    error_idx: int
    controls: ctypes._Pointer[ExtControl]
    _fields_ = (
        ("which", u32),
        ("count", u32),
        ("error_idx", u32),
        ("request_fd", s32),
        ("reserved", u32),
        ("controls", ctypes.POINTER(ExtControl)),
    )


_READ, _WRITE = 2, 1  # as the kernel calls the directions: the driver's answer, the caller's question


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


def _both(number: int, structure: type[ctypes.Structure]) -> int:
    return _request(_READ | _WRITE, number, ctypes.sizeof(structure))


VIDIOC_QUERYCAP = _request(_READ, 0, ctypes.sizeof(Capability))
VIDIOC_ENUM_FMT = _both(2, FmtDesc)
VIDIOC_G_FMT = _both(4, Format)
VIDIOC_S_FMT = _both(5, Format)
VIDIOC_REQBUFS = _both(8, RequestBuffers)
VIDIOC_QUERYBUF = _both(9, Buffer)
VIDIOC_QBUF = _both(15, Buffer)
VIDIOC_DQBUF = _both(17, Buffer)
VIDIOC_STREAMON = _request(_WRITE, 18, ctypes.sizeof(ctypes.c_int))
VIDIOC_STREAMOFF = _request(_WRITE, 19, ctypes.sizeof(ctypes.c_int))
VIDIOC_G_PARM = _both(21, StreamParm)
VIDIOC_S_PARM = _both(22, StreamParm)
VIDIOC_QUERYMENU = _both(37, QueryMenu)
VIDIOC_TRY_FMT = _both(64, Format)
VIDIOC_G_EXT_CTRLS = _both(71, ExtControls)
VIDIOC_S_EXT_CTRLS = _both(72, ExtControls)
VIDIOC_ENUM_FRAMESIZES = _both(74, FrmSizeEnum)
VIDIOC_ENUM_FRAMEINTERVALS = _both(75, FrmIvalEnum)
VIDIOC_G_SELECTION = _both(94, Selection)
VIDIOC_S_SELECTION = _both(95, Selection)
VIDIOC_QUERY_EXT_CTRL = _both(103, QueryExtCtrl)
