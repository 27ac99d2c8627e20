"""One camera of the rig: its grabber, its reader thread, its settings, and its reconnection after a loss."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from core.errors import CameraError
from core.names import CameraName
from drivers.acquisition.frame_counter import SequenceReader
from drivers.acquisition.reader import CameraReader
from drivers.cameras.protocol import CameraDescription, CameraSettings, Frame, FrameCounters, FrameGrabber, TriggerMode

# From a trigger to its frame, beyond the exposure: a generous read-out, and the slowest usual line
_READ_OUT_S = 0.2
_BYTES_PER_S = 50e6
# A device may round what it is given by its own steps
_RELATIVE = 1e-3


class CameraUnit:
    """One camera.

    Parameters
    ----------
    name
        ``cam1`` or ``cam2``.
    make
        Makes a new grabber of the camera: the handle of a lost one never works again.
    trigger
        Trigger mode of its exposures.
    rate_hz
        Rate in free run, or of the pulses of a hardware trigger; ``None`` when pulses come irregularly, and then their
        absence means nothing.
    serial
        Serial number that the camera must have; ``None`` takes any at first, and then the same one.
    size_px
        Width and height of the images that the rig expects; ``None`` takes any.
    on_lost
        Called from the reader's thread when the camera is lost.
    """

    def __init__(
        self,
        name: CameraName,
        make: Callable[[], FrameGrabber],
        *,
        trigger: TriggerMode = "software",
        rate_hz: float | None = None,
        serial: str | None = None,
        size_px: tuple[int, int] | None = None,
        on_lost: Callable[[CameraName, CameraError], None] | None = None,
    ) -> None:
        self.name: CameraName = name
        self.trigger: TriggerMode = trigger
        self.rate_hz = rate_hz
        self.latest: Frame | None = None
        self._make = make
        self._serial = serial
        self._size_px = size_px
        self._on_lost = on_lost
        self._wanted = CameraSettings()
        self._reader: CameraReader | None = None
        self._fault: CameraError | None = None
        self._earlier = FrameCounters()
        self._guard = threading.Lock()
        self.reconnections = 0

    def open(self, settings: CameraSettings) -> None:
        """Connect, check its identity, push settings, arm.

        Raises
        ------
        CameraError
            ``wrong_camera`` when another serial number answers, ``image_size_mismatch`` when its images have another
            size than the rig file says, or an error of the device.
        """
        wanted = replace(settings, trigger=self.trigger)
        if self.trigger == "free" and self.rate_hz is not None:
            wanted = replace(wanted, frame_rate_hz=self.rate_hz)
        self._connect(wanted)
        self._start()

    def _connect(self, wanted: CameraSettings) -> None:
        self.grabber: FrameGrabber = self._make()
        self.grabber.open()
        self.description: CameraDescription = self.grabber.describe()
        if self._serial is not None and self.description.serial != self._serial:
            raise CameraError(
                f"{self.name} is the camera {self.description.serial}, the rig expects {self._serial}.",
                code="wrong_camera",
                remedy="Check the cables, or correct device and serial in the rig file.",
                camera=self.name,
            )
        self._serial = self.description.serial
        self._wanted = wanted
        self._take(wanted)
        self._check_size()

    def _check_size(self) -> None:
        region = self.settings.region_px
        size = self.description.image_size_px if region is None else (region[2], region[3])
        if self._size_px is not None and tuple(size) != self._size_px:
            raise CameraError(
                f"{self.name} delivers images of {size[0]} x {size[1]} px, the rig file says {self._size_px[0]} x "
                f"{self._size_px[1]} px.",
                code="image_size_mismatch",
                remedy="Correct image_size_px, or give region_px in the rig file.",
                camera=self.name,
            )

    def _take(self, settings: CameraSettings) -> None:
        self.settings: CameraSettings = self.grabber.configure(settings)
        self.description = self.grabber.describe()

    def reconnect(self) -> None:
        """Connect a lost camera again and give it the settings it had; `resume` then puts it to work.

        Raises
        ------
        CameraError
            ``settings_not_restored`` when it does not take what it had before, or an error of the device.
        """
        had = self.settings
        self.release()
        try:
            self._connect(self._wanted)
            lost = _differences(had, self.settings)
            if lost:
                raise CameraError(
                    f"{self.name} came back and did not take its settings again: {'; '.join(lost)}.",
                    code="settings_not_restored",
                    remedy="Check the camera, then PATCH its settings.",
                    camera=self.name,
                )
        except CameraError as error:
            self.settings = had
            self.release()
            self._fault = error
            raise

    def resume(self) -> None:
        """Arm a camera that was connected again; only then its fault is over."""
        self.reconnections += 1
        self._start()

    @property
    def period_s(self) -> float:
        """Longest time from a trigger to its frame, or the frame period."""
        if self.trigger != "software" and self.rate_hz is not None:
            return 1.0 / self.rate_hz
        columns, rows = self.description.image_size_px
        return (self.settings.exposure_ms or 0.0) / 1000.0 + max(_READ_OUT_S, 2 * columns * rows / _BYTES_PER_S)

    @property
    def patience_s(self) -> float:
        """Longest time of a triggered frame."""
        return self.period_s + self.description.latency_s

    def _start(self) -> None:
        first, last = self.description.counter_range
        reader = CameraReader(
            self.grabber,
            name=self.name,
            period_s=self.period_s,
            expects_frames=self.trigger == "free" or (self.trigger == "hardware" and self.rate_hz is not None),
            sequence=SequenceReader(first, last),
            pass_incomplete=True,
            on_fault=self._lose,
        )
        self._fault = None
        self._reader = reader
        reader.start()

    def _lose(self, error: CameraError) -> None:
        self._fault = error
        self.latest = None
        if self._on_lost is not None:
            self._on_lost(self.name, error)

    def _stop(self) -> None:
        with self._guard:
            reader, self._reader = self._reader, None
        if reader is not None:
            reader.stop()
            new, old = reader.counters.as_dict(), self._earlier.as_dict()
            self._earlier = FrameCounters(**{name: old[name] + n for name, n in new.items()})

    @property
    def reader(self) -> CameraReader:
        """Return the running reader; raise the reason where there is none."""
        reader, fault = self._reader, self._fault
        if reader is None or fault is not None:
            cause = f"{self.name} is not armed." if fault is None else fault.cause
            raise CameraError(
                cause,
                code="camera_lost" if fault is None else fault.code,
                remedy="Check its cable and power; it is connected again by itself, or POST /rig/reconnect.",
                camera=self.name,
            )
        return reader

    @property
    def wanted(self) -> CameraSettings:
        """Settings requested so far, which a reconnected camera is given again."""
        return self._wanted

    @property
    def fault(self) -> CameraError | None:
        """Error for which the camera cannot be used, or None."""
        return self._fault

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change settings; the camera is armed again afterwards in any case."""
        _ = self.reader
        self._stop()
        try:
            self._take(settings)
            given = {name: value for name, value in vars(settings).items() if value is not None}
            if settings.features is not None:
                given["features"] = {**(self._wanted.features or {}), **settings.features}
            self._wanted = replace(self._wanted, **given)
            if settings.frame_rate_hz is not None and self.trigger == "free":
                self.rate_hz = self.settings.frame_rate_hz or settings.frame_rate_hz
        finally:
            self._start()
        return self.settings

    def counters(self) -> dict[str, int]:
        """Return the counters of the frames since the camera was opened."""
        reader = self._reader
        now = FrameCounters() if reader is None else reader.counters
        old = self._earlier.as_dict()
        return {name: old[name] + n for name, n in now.as_dict().items()}

    def statistics(self) -> dict[str, int | float]:
        """The driver's own counts."""
        return {} if self._reader is None else self.grabber.statistics()

    def release(self) -> None:
        """End the reader, let the camera go; safe to call twice."""
        self._stop()
        grabber = getattr(self, "grabber", None)
        if grabber is not None:
            grabber.close()

    close = release


def _differences(had: CameraSettings, has: CameraSettings) -> list[str]:
    """Return the settings that have changed, as texts."""
    before, now = asdict(had), asdict(has)
    features: dict[str, Any] = before.pop("features") or {}
    features_now: dict[str, Any] = now.pop("features") or {}
    found = [(name, value, now[name]) for name, value in before.items()]
    found += [(name, value, features_now.get(name)) for name, value in features.items()]
    return [f"{name} was {value}, is {new}" for name, value, new in found if not _same(value, new)]


def _same(one: Any, two: Any) -> bool:
    numbers = (int, float)
    if isinstance(one, numbers) and isinstance(two, numbers):
        return abs(one - two) <= _RELATIVE * max(abs(one), abs(two))
    return bool(one == two)
