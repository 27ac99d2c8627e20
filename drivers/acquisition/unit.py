"""One camera of the rig: its grabber, its reader thread, its settings, and its reconnection after a loss."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.core.names import CameraName
from stereorig.drivers.acquisition.frame_counter import SequenceReader
from stereorig.drivers.acquisition.reader import CameraReader
from stereorig.drivers.cameras.genicam.describe import GIGE
from stereorig.drivers.cameras.genicam.link import LOAD, SHARES, interface_of, speed_of
from stereorig.drivers.cameras.genicam.synonyms import THROUGHPUT_MODE
from stereorig.drivers.cameras.protocol import (
    CameraDescription,
    CameraSettings,
    Frame,
    FrameCounters,
    FrameGrabber,
    LatchingGrabber,
    TriggerMode,
)

# From a trigger to its frame, beyond the exposure: a generous read-out, and the slowest usual line
_READ_OUT_S = 0.2
_BYTES_PER_S = 50e6
# A busy host may not look at a fast camera's frames for so long
_FAST_HZ = 100.0
_BUFFER_S = 1.0
# A device may round a value to its own steps
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
        self._description: CameraDescription | None = None
        self._settings: CameraSettings | None = None
        self._found = False
        self._share: tuple[float, float] | None = None
        #: beginning of its connection, its loss or the search for it, seconds of Unix time
        self.since_s = time.time()
        self.reconnections = 0
        #: the camera's answers to commands of its own kind, for its statistics
        self.commands: Counter[str] = Counter()

    def open(self, settings: CameraSettings) -> None:
        """Connect, check its identity, push settings, arm.

        Raises
        ------
        CameraError
            ``wrong_camera`` when another serial number answers, ``image_size_mismatch`` when its images have another
            size than in the rig file, or an error of the device.
        """
        self.look_for(settings)
        self._connect()
        self._start()

    def look_for(self, settings: CameraSettings) -> None:
        """Take the settings with which `reconnect` opens it; until then it has a fault."""
        self._wanted = replace(settings, trigger=self.trigger)
        if self.trigger == "free" and self.rate_hz is not None:
            self._wanted = replace(self._wanted, frame_rate_hz=self.rate_hz)
        self._fault = CameraError(
            f"{self.name} was not found yet: its driver is opening it.",
            code="camera_lost",
            remedy="Wait; check its cable and power if it does not come.",
            camera=self.name,
        )

    def _connect(self) -> None:
        self.grabber: FrameGrabber = self._make()
        self.grabber.open()
        found = self._description = self.grabber.describe()
        if self._serial is not None and found.serial != self._serial:
            raise CameraError(
                f"{self.name} is the camera {found.serial}, the rig expects {self._serial}.",
                code="wrong_camera",
                remedy="Check the cables, or correct device and serial in the rig file.",
                camera=self.name,
            )
        self._take(self._wanted)
        self._take_share()
        self._check_size()
        self._serial = found.serial

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
        self._settings = self.grabber.configure(settings)
        self._description = self.grabber.describe()

    def hold_back(self, bytes_per_s: float, link_bytes_per_s: float) -> None:
        """Give a connected camera a share of its link, now and after each return; its error becomes its fault."""
        if self._share == (bytes_per_s, link_bytes_per_s):
            return
        self._share = bytes_per_s, link_bytes_per_s
        self._stop()
        try:
            self._take_share()
            self._start()
        except CameraError as error:
            self.release()
            self._fault = error

    def _take_share(self) -> None:
        given = self._wanted.features or {}
        if (
            self._share is None
            or not isinstance(self.grabber, LatchingGrabber)
            or {*SHARES, THROUGHPUT_MODE} & set(given)
        ):
            return
        try:
            self.grabber.hold_back(*self._share)
        except CameraError as error:
            # the description shows the share that it has
            if error.code == "camera_lost":
                raise
        self._take(CameraSettings())  # its rate may be another now
        rate_hz = self.settings.frame_rate_hz
        if rate_hz is not None and rate_hz < (self._wanted.frame_rate_hz or 0.0):
            self._wanted = replace(self._wanted, frame_rate_hz=rate_hz)  # it takes no more when it comes back

    @property
    def description(self) -> CameraDescription:
        """Identity and abilities of the camera, with its reader's notes; raises the fault if it was not found."""
        reader, known = self._reader, self._description
        if known is None:
            raise self._missing()
        notes = {} if reader is None else reader.notes
        return replace(known, extra={**known.extra, **notes}) if notes else known

    @property
    def settings(self) -> CameraSettings:
        """Settings as read back; raises as `description`."""
        if self._settings is None:
            raise self._missing()
        return self._settings

    @property
    def was_found(self) -> bool:
        """True if it was connected at any time."""
        return self._found

    def reconnect(self) -> None:
        """Connect a lost camera again and give it the settings it had; `resume` then puts it to work.

        Raises
        ------
        CameraError
            ``settings_not_restored`` when it does not take its earlier settings, ``driver_failed`` with the error of a
            driver that raises another one, or an error of the device.
        """
        had, known = self._settings, self._description
        try:
            self.release()
            self._connect()
            lost = [] if had is None else _differences(had, self.settings)
            if lost:
                raise CameraError(
                    f"{self.name} came back and did not take its settings again: {'; '.join(lost)}.",
                    code="settings_not_restored",
                    remedy="Check the camera, then PATCH its settings.",
                    camera=self.name,
                )
        except Exception as error:  # noqa: BLE001 - a driver may bring up anything, which must be shown
            self._settings, self._description = had, known
            with contextlib.suppress(Exception):
                self.release()
            fault = self._fault = error if isinstance(error, CameraError) else self._failed(error)
            raise fault from (None if fault is error else error)

    def _failed(self, error: Exception) -> CameraError:
        return CameraError(
            f"The driver of {self.name} has failed: {type(error).__name__}: {error}",
            code="driver_failed",
            remedy="Install what the message names; report it with the message if the camera works elsewhere.",
            camera=self.name,
        )

    def resume(self) -> None:
        """Arm a camera that was connected again; only then its fault is over."""
        self.reconnections += self._found
        self._start()

    @property
    def period_s(self) -> float:
        """Longest time from a trigger to its frame, or the frame period."""
        if self.trigger in ("free", "hardware") and self.rate_hz is not None:
            return 1.0 / self.rate_hz
        columns, rows = self.description.image_size_px
        return (self.settings.exposure_ms or 0.0) / 1000.0 + max(_READ_OUT_S, 2 * columns * rows / _BYTES_PER_S)

    @property
    def patience_s(self) -> float:
        """Longest time of a triggered frame."""
        return self.period_s + self.description.latency_s

    def _start(self) -> None:
        first, last = self.description.counter_range
        rate_hz = self.rate_hz or 0.0
        reader = CameraReader(
            self.grabber,
            name=self.name,
            period_s=self.period_s,
            expects_frames=self.trigger == "free" or (self.trigger == "hardware" and self.rate_hz is not None),
            buffer_frames=round(_BUFFER_S * rate_hz) if rate_hz > _FAST_HZ else 8,
            sequence=SequenceReader(first, last),
            pass_incomplete=True,
            on_fault=self._lose,
            on_clock=self._describe_clock,
        )
        self._fault, self._found, self.since_s = None, True, time.time()
        self._reader = reader
        reader.start()

    def _describe_clock(self, description: CameraDescription) -> None:
        # only this: the rest may be older than settings made since then
        known = self._description
        if known is None:
            return
        self._description = replace(
            known,
            clock=description.clock,
            clock_error_ms=description.clock_error_ms,
            extra={**known.extra, **{k: v for k, v in description.extra.items() if k.startswith("ptp")}},
        )

    def _lose(self, error: CameraError) -> None:
        self._fault, self.since_s = error, time.time()
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
        """Return the running reader; raise the reason if there is none."""
        reader = self._reader
        if reader is None or self._fault is not None:
            raise self._missing()
        return reader

    def _missing(self) -> CameraError:
        fault = self._fault
        return CameraError(
            f"{self.name} is not armed." if fault is None else fault.cause,
            code="camera_lost" if fault is None else fault.code,
            remedy="Check its cable and power; it is connected again by itself, or POST /rig:reconnect.",
            camera=self.name,
        )

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
        return {} if self._reader is None else {**self.grabber.statistics(), **self.commands}

    def release(self) -> None:
        """End the reader, let the camera go; safe to call twice."""
        self._stop()
        grabber = getattr(self, "grabber", None)
        if grabber is not None:
            grabber.close()

    close = release


def share_links(units: Iterable[CameraUnit]) -> None:
    """Share the speed of each interface evenly out over the connected GigE Vision cameras that send to it."""
    on: dict[str | None, list[CameraUnit]] = {}
    for unit in units:
        if unit.fault is None and unit.was_found and unit.description.extra.get("protocol") == GIGE:
            on.setdefault(interface_of(unit.description.extra["address"]), []).append(unit)
    for name, sharing in on.items():
        speed = None if name is None else speed_of(name)
        if speed is not None and len(sharing) > 1:
            for unit in sharing:
                unit.hold_back(LOAD * speed / len(sharing), speed)


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
