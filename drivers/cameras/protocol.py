"""Interface of the camera drivers: frames, settings, counters and the grabber protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from core.errors import CameraError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
TriggerMode = Literal["free", "software", "hardware"]
FeatureValue = bool | int | float | str


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
        The device's own frame number; wraps where the device's counter does.
    device_ns
        Start of the exposure by the device's clock, in ns; its zero is the device's own.
    host_ns
        Arrival by the host's monotonic clock, in ns.
    status
        Anything but ``OK`` is counted and discarded by the reader.
    trigger
        Number of the trigger that made this frame, where the device or driver knows it; pairs are made by it.
    exposed_ns
        Start of the exposure converted to the host's monotonic clock (`drivers.acquisition.clocks`), set by the reader.
    """

    pixels: Pixels
    bit_depth: int
    sequence: int
    device_ns: int
    host_ns: int
    status: FrameStatus = FrameStatus.OK
    trigger: int | None = None
    exposed_ns: int | None = None

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

    Attributes
    ----------
    exposure_ms, gain_db, frame_rate_hz
        Read back, they are the device's own, which may round them; ``None`` where the device has no such setting.
    bit_depth
        Significant bits; the driver takes the plainest pixel format that carries them. ``pixel_format`` names one.
    trigger
        Start of an exposure: by itself, by a call, by a pulse on the camera's line.
    region_px
        x0, y0, width, height on the sensor.
    pixel_format
        The device's own name: ``Mono12Packed`` (GenICam), ``Y12 `` (V4L2).
    features
        Anything else by the device's own name (GenICam feature, V4L2 control), set in this order.
    """

    exposure_ms: float | None = None
    gain_db: float | None = None
    frame_rate_hz: float | None = None
    bit_depth: int | None = None
    trigger: TriggerMode | None = None
    region_px: tuple[int, int, int, int] | None = None
    pixel_format: str | None = None
    features: Mapping[str, FeatureValue] | None = None


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
        Switch the camera's IEEE 1588 clock on; opening fails with ``ptp_unsupported`` where it has none.
    trigger_source, trigger_edge
        Line of the hardware trigger.
    trigger_features
        Trigger mode -> features that bring the device there, for devices that have no standard way (V4L2).
    """

    device: str
    buffers: int = 16
    packet_size_bytes: int | None = None
    ptp: bool = False
    trigger_source: str = "Line1"
    trigger_edge: Literal["rising", "falling"] = "rising"
    trigger_features: Mapping[TriggerMode, Mapping[str, FeatureValue]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class FoundDevice:
    """A device found by discovery.

    Attributes
    ----------
    kind
        Possible use; a serial port may hold anything.
    driver
        Driver to name in the rig file; empty for a serial port.
    device
        Value of ``device`` (cameras) or ``url`` (stages) in the rig file.
    problem
        Reason for which it cannot be used as it is, with the remedy; ``None`` without a known problem.
    """

    kind: Literal["camera", "serial"]
    driver: str
    device: str
    model: str = ""
    serial: str = ""
    address: str = ""
    problem: str | None = None
    extra: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CameraDescription:
    """Identity and abilities of a camera.

    Ranges are (lowest, highest) as the device reports them; ``None`` where the device has no such setting.
    ``latency_s`` is the longest time of a frame beyond its period before it arrives, for the watchdog: zero but for
    cameras that render. ``clock`` names the clock of ``Frame.device_ns``: those of two cameras may be compared when
    both name the same one (``sim``, ``monotonic``, ``ptp:<grandmaster>``); empty for a clock of the camera's own.
    ``counter_range`` is where ``Frame.sequence`` starts again and ends before it wraps. ``feature_names`` are what
    ``CameraSettings.features`` may name.
    """

    model: str
    serial: str
    image_size_px: tuple[int, int]  # width, height
    bit_depths: tuple[int, ...]
    trigger_modes: tuple[TriggerMode, ...]
    exposure_range_ms: tuple[float, float] | None
    gain_range_db: tuple[float, float] | None
    frame_rate_range_hz: tuple[float, float] | None
    driver: str
    firmware: str = ""
    latency_s: float = 0.0
    clock: str = ""
    counter_range: tuple[int, int] = (0, 2**16 - 1)
    pixel_formats: tuple[str, ...] = ()
    feature_names: tuple[str, ...] = ()
    extra: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameCounters:
    """Counters of the frames that a camera announced since it was armed.

    ``delivered`` reached the consumer or waits in the buffer; ``overrun`` was discarded because the consumer was too
    slow; ``dropped`` never arrived (gaps in the sequence numbers); the other names are reasons for which a frame was
    not delivered.
    """

    delivered: int = 0
    overrun: int = 0
    dropped: int = 0
    incomplete: int = 0
    duplicates: int = 0
    out_of_order: int = 0

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
        """Set what is not ``None`` and return every setting as read back from the device.

        A value outside the device's range is refused with code ``out_of_range`` before anything is changed; a setting
        or feature that the device does not have with ``unknown_feature``; one that cannot be changed while armed with
        ``armed``.
        """

    def arm(self) -> None:
        """Start delivering: in free run at once, else one frame a trigger."""

    def disarm(self) -> None:
        """Stop delivering; a wait in `next_frame` ends with a timeout."""

    def trigger(self) -> int | None:
        """Fire one software trigger; return its number where the driver counts them. Code ``wrong_trigger`` else."""

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, complete or not; ``None`` when none came in time.

        Raises `CameraError` with code ``camera_lost`` when the device reports that it is gone.
        """

    def statistics(self) -> dict[str, int | float]:
        """Return the driver's own counts since `open` (buffers, packets, resends ...), never waiting for the device."""

    def close(self) -> None:
        """Release the device; safe to call twice."""
