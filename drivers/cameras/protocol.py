"""Interface of the camera drivers: frames, settings, counters and the grabber protocol.

The description of a camera is declared here, each field with its meaning; replies and records of the service derive
from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Annotated, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stereorig.core.errors import CameraError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
TriggerMode = Literal["free", "software", "hardware", "action"]
FeatureValue = bool | int | float | str
#: lowest and highest value, as the device reports them
Range = tuple[float, float]


class FrameStatus(StrEnum):
    """Usability of a frame's pixels."""

    OK = "ok"
    INCOMPLETE = "incomplete"  # lines or packets are missing; never delivered as a measurement image


@dataclass(frozen=True, eq=False)
class Frame:
    """One digitised image and its number in its camera's sequence.

    Attributes
    ----------
    pixels
        Gray image, shape (rows, columns), uint8 up to 8 bit and uint16 above; significant bits right-aligned.
    bit_depth
        Significant bits per pixel, so that saturation is ``2**bit_depth - 1``.
    sequence
        The device's own frame number; it wraps as the device's counter does.
    device_ns
        Start of the exposure by the device's clock, in ns; its zero is the device's own.
    host_ns
        Arrival by the host's monotonic clock, in ns.
    status
        Anything but ``OK`` is counted and discarded by the reader.
    trigger
        Number of the trigger that made this frame, if the device or driver knows it; pairs are made by it.
    exposed_ns
        Start of the exposure converted to the host's monotonic clock by the frames' arrival, plus the camera's shortest
        delay (`stereorig.drivers.acquisition.clocks`), set by the reader.
    latched_ns, latched_error_ns
        Start of the exposure on the host's monotonic clock by latches of the camera's clock, and the largest error of
        that conversion; set by the reader if the camera has a latch.
    stamped
        False if the device gave no time, and ``device_ns`` is the arrival's; set by the reader.
    """

    pixels: Pixels
    bit_depth: int
    sequence: int
    device_ns: int
    host_ns: int
    status: FrameStatus = FrameStatus.OK
    trigger: int | None = None
    exposed_ns: int | None = None
    latched_ns: int | None = None
    latched_error_ns: int = 0
    stamped: bool = True

    @property
    def begun_ns(self) -> int:
        """Start of the exposure on the host's monotonic clock, as well as it is known."""
        known = (self.latched_ns, self.exposed_ns, self.host_ns)
        return next(at for at in known if at is not None)

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or self.pixels.dtype not in (np.uint8, np.uint16):
            raise CameraError(
                f"A frame must be a gray uint8 or uint16 image, got shape {self.pixels.shape} of {self.pixels.dtype}.",
                code="frame_format",
                remedy="Choose a Mono pixel format in the camera's settings.",
            )
        room = 8 * self.pixels.dtype.itemsize
        if not 1 <= self.bit_depth <= room:
            raise CameraError(
                f"A frame of {self.pixels.dtype} cannot hold {self.bit_depth} significant bits.",
                code="frame_format",
                remedy="Choose a Mono pixel format in the camera's settings.",
            )


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Settings as requested; ``None`` leaves the device's own. `FrameGrabber.configure` returns them as read back.

    Read back, they are the device's own, which may round them; ``None`` for a setting that it does not have. For
    ``bit_depth`` the driver takes the plainest pixel format that carries it; ``pixel_format`` names one:
    ``Mono12Packed`` (GenICam), ``Y12 `` (V4L2). ``features`` are GenICam features or V4L2 controls, set in this order.
    """

    exposure_ms: Annotated[float | None, Field(description="Exposure time.")] = None
    gain_db: Annotated[float | None, Field(description="Gain.")] = None
    frame_rate_hz: Annotated[float | None, Field(description="Rate of a free run.")] = None
    bit_depth: Annotated[int | None, Field(description="Significant bits per pixel.")] = None
    trigger: Annotated[TriggerMode | None, Field(description="What starts an exposure.")] = None
    region_px: Annotated[
        tuple[int, int, int, int] | None, Field(description="x0, y0, width, height on the sensor.")
    ] = None
    pixel_format: Annotated[str | None, Field(description="The device's own name of the pixel format.")] = None
    features: Annotated[
        Mapping[str, FeatureValue] | None,
        Field(description="Other settings that were given, by the device's own name."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Connection of a driver to its camera: options that are set once, when it is opened.

    Attributes
    ----------
    device
        The driver's name of the device, as `discover` lists it: an Aravis id or IP address, ``/dev/video0``, or a
        stable link below ``/dev/v4l``.
    buffers
        Frames that may be under way between device and reader.
    packet_size_bytes
        GigE Vision packets; ``None`` asks the network for the largest that passes.
    ptp
        Switch the camera's IEEE 1588 clock on; opening fails with ``ptp_unsupported`` if it has none.
    trigger_source, trigger_edge
        Line of the hardware trigger.
    action_keys
        Device key, group key and group mask of the action commands that trigger it (GigE Vision).
    trigger_features
        Trigger mode -> features that bring the device there, for devices that have no standard way (V4L2).
    """

    device: str
    buffers: int = 16
    packet_size_bytes: int | None = None
    ptp: bool = False
    trigger_source: str = "Line1"
    trigger_edge: Literal["rising", "falling"] = "rising"
    action_keys: tuple[int, int, int] | None = None
    trigger_features: Mapping[TriggerMode, Mapping[str, FeatureValue]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class FoundDevice:
    """A device found by discovery."""

    kind: Annotated[Literal["camera", "serial"], Field(description="Possible use; a serial port may hold anything.")]
    driver: Annotated[
        str, Field(description="`driver` for the rig file; empty for a serial port.", examples=["aravis"])
    ]
    device: Annotated[
        str,
        Field(description="`device` (camera) or `url` (serial port) for the rig file.", examples=["Aravis-Fake-GV01"]),
    ]
    model: Annotated[str, Field(description="Maker and model as the device gives them; empty if it does not.")] = ""
    serial: Annotated[str, Field(description="Serial number; empty if the device gives none.")] = ""
    address: Annotated[str, Field(description="Network address, bus position or USB ids; empty if there is none.")] = ""
    problem: Annotated[
        str | None, Field(description="Why it cannot be used as it is, and what to do; null if nothing is known.")
    ] = None
    extra: Annotated[
        Mapping[str, str], Field(description="What else is known: `link` is a serial port's lasting name.")
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class CameraIdentity:
    """Identity of a camera, as stored with its images."""

    model: Annotated[str, Field(description="Model.", examples=["simulated camera"])]
    serial: Annotated[str, Field(description="Serial number.")]


@dataclass(frozen=True)
class CameraDescription(CameraIdentity):
    """Identity and abilities of a camera; a range is ``None`` if the device has no such setting.

    ``latency_s`` is for the watchdog: zero but for cameras that render. ``clock`` names the clock of
    ``Frame.device_ns`` (``sim``, ``monotonic``, ``ptp:<grandmaster>``); empty for a clock of the camera's own;
    ``clock_error_ms`` is the largest error of a time by a clock that has a name. ``counter_range`` is the range of
    ``Frame.sequence``.
    """

    image_size_px: Annotated[tuple[int, int], Field(description="Width and height of its images.")]
    bit_depths: Annotated[tuple[int, ...], Field(description="Significant bits per pixel that it can deliver.")]
    trigger_modes: Annotated[tuple[TriggerMode, ...], Field(description="What may start an exposure.")]
    exposure_range_ms: Annotated[Range | None, Field(description="Shortest and longest exposure.")]
    gain_range_db: Annotated[Range | None, Field(description="Least and greatest gain.")]
    frame_rate_range_hz: Annotated[Range | None, Field(description="Lowest and highest rate of a free run.")]
    driver: Annotated[str, Field(description="Driver that reaches it.", examples=["aravis"])]
    firmware: Annotated[str, Field(description="Firmware; empty where it does not report it.")] = ""
    latency_s: Annotated[float, Field(description="What a frame may take beyond its period before it arrives.")] = 0.0
    clock: Annotated[
        str, Field(description="Clock of its times; two cameras' may be compared where both name the same one.")
    ] = ""
    clock_error_ms: Annotated[float, Field(description="Largest error of a time by that clock.")] = 0.0
    counter_range: Annotated[
        tuple[int, int], Field(description="First and last frame number before it begins again.")
    ] = (0, 2**16 - 1)
    pixel_formats: Annotated[tuple[str, ...], Field(description="Pixel formats, by the device's own names.")] = ()
    feature_names: Annotated[tuple[str, ...], Field(description="What `features` of the settings may name.")] = ()
    extra: Annotated[Mapping[str, str], Field(description="What else the driver knows, as text.")] = field(
        default_factory=dict
    )
    temperature_c: Annotated[
        float | None, Field(description="Its temperature, degrees Celsius, at most seconds old; null if not known.")
    ] = None


@dataclass(frozen=True)
class FrameCounters:
    """Counters of the frames that a camera announced since it was opened."""

    delivered: Annotated[int, Field(description="Frames that came whole.")] = 0
    overrun: Annotated[int, Field(description="Thrown away because nobody took them in time.")] = 0
    #: gaps in the sequence numbers
    dropped: Annotated[int, Field(description="Never arrived, by their numbers.")] = 0
    incomplete: Annotated[int, Field(description="Arrived with lines or packets missing; never used.")] = 0
    duplicates: Annotated[int, Field(description="Delivered twice.")] = 0
    out_of_order: Annotated[int, Field(description="Arrived after a later one.")] = 0

    def as_dict(self) -> dict[str, int]:
        """Return names and numbers, for reports."""
        return asdict(self)


@runtime_checkable
class FrameGrabber(Protocol):
    """One camera. Calls come from one thread at a time, except `close`, which any thread may call at any moment.

    Order of calls: ``open``, ``describe``, ``configure``, ``arm``, then ``trigger`` and ``next_frame``, ``disarm``,
    ``close``. After a `CameraError` with code ``camera_lost`` only ``close`` and ``open`` make sense.
    """

    def open(self) -> None:
        """Connect. Raises `CameraError` (``camera_lost``, ``camera_busy``) when it cannot."""

    def describe(self) -> CameraDescription:
        """Return the camera's identity and abilities; ranges may depend on its settings."""

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the values that are not ``None`` and return every setting as read back from the device.

        A value outside the device's range is refused with code ``out_of_range`` before anything is changed; a setting
        or feature that the device does not have with ``unknown_feature``; one that cannot be changed while armed with
        ``armed``.
        """

    def arm(self) -> None:
        """Start delivering: in free run at once, else one frame a trigger."""

    def disarm(self) -> None:
        """Stop delivering; a wait in `next_frame` ends with a timeout."""

    def trigger(self) -> int | None:
        """Fire one software trigger; return its number if the driver counts them. Code ``wrong_trigger`` else."""

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, complete or not; ``None`` when none came in time.

        Raises `CameraError` with code ``camera_lost`` when the device reports that it is gone.
        """

    def statistics(self) -> dict[str, int | float]:
        """Return the driver's own counts since `open` (buffers, packets, resends ...), never waiting for the device."""

    def close(self) -> None:
        """Release the device; safe to call twice."""


class Latch(NamedTuple):
    """A camera's time, and two times of the host's monotonic clock between which the camera latched it, in ns."""

    before_ns: int
    device_ns: int
    after_ns: int


@runtime_checkable
class LatchingGrabber(Protocol):
    """A `FrameGrabber` whose camera can be asked for its time, by any thread while it is armed, and be held back."""

    def latch(self) -> Latch | None:
        """Return the camera's time now; ``None`` if it has no latch. Raises `CameraError`."""

    def renew_clock(self) -> CameraDescription:
        """Look again at clock and temperature, and return the description. Raises `CameraError`."""

    def hold_back(self, bytes_per_s: float, link_bytes_per_s: float) -> None:
        """Let the camera, disarmed, send at most so much of its link's speed, if it can. Raises `CameraError`."""
