"""Simulated cameras: frame grabbers over the simulated world, with one trigger line and settable faults."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import queue
import threading
import time
import weakref
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraDescription, CameraSettings, Frame, FrameStatus, Pixels

_NICE = 5


# A trigger call within this time of the first camera's belongs to the same pulse, however busy the machine is
_SAME_PULSE_S = 10.0
# Frames that wait to be taken; a real grabber's ring is as short
_RING = 16
_FRESH_HZ = 100.0  # above it images come back, which takes less time than fresh noise
_BEHIND_S = 1.0  # as far as its thread may be late then


class Exposer(Protocol):
    """The world as a simulated camera uses it; `stereorig.sim.world.SimWorld` is one."""

    def expose(self, cam: CameraName, *, exposure_ms: float, gain_db: float, rng: np.random.Generator | None) -> Pixels:
        """Return the digitised image of this moment."""


@dataclass(frozen=True)
class Pulse:
    """One pulse on the trigger line."""

    number: int
    at_ns: int


@dataclass
class GrabberFaults:
    """Faults of a camera; every value may be set while it runs.

    Attributes
    ----------
    drop
        So many of the next frames never arrive, though they were counted.
    duplicate
        So many of the next frames arrive twice.
    incomplete
        So many of the next frames lack their lower half.
    silent
        Nothing arrives, and no error either.
    busy
        Opening fails, as when another program holds the camera.
    gone
        The camera reports that it is gone, and cannot be opened.
    skew_ms
        Delay of this camera's exposures.
    """

    drop: int = 0
    duplicate: int = 0
    incomplete: int = 0
    silent: bool = False
    busy: bool = False
    gone: bool = False
    skew_ms: float = 0.0


class TriggerLine:
    """One line to all cameras of a rig: the first camera's software trigger makes the pulse, the others join it.

    So the exposures of a pair begin at the same instant, at any delay of the second call.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest = Pulse(0, 0)
        self._last_of: dict[str, int] = {}
        self._holders: dict[str, object] = {}
        self._faults: dict[str, GrabberFaults] = {}
        self._waiting: dict[str, queue.SimpleQueue[Pulse | None]] = {}

    @property
    def newest(self) -> Pulse:
        """The pulse that came last; number 0 before the first."""
        return self._newest

    def listen(self, cam: str, orders: queue.SimpleQueue[Pulse | None] | None) -> None:
        """Send the pulses of the line to a camera in hardware trigger mode; ``None`` ends that."""
        with self._lock:
            if orders is None:
                self._waiting.pop(cam, None)
            else:
                self._waiting[cam] = orders

    def pulse(self, *, missed_by: str | None = None) -> Pulse:
        """Send a pulse down the line, as a pulse generator does; a camera that is not ready misses it."""
        with self._lock:
            pulse = self._newest = Pulse(self._newest.number + 1, time.monotonic_ns())
            for cam, orders in self._waiting.items():
                if cam != missed_by:
                    orders.put(pulse)
            return pulse

    def faults_of(self, cam: str) -> GrabberFaults:
        """Faults of a camera: they persist when a new grabber is made for it."""
        return self._faults.setdefault(cam, GrabberFaults())

    def hold(self, cam: str, holder: object) -> bool:
        """Take a camera for one grabber; False when another has it."""
        with self._lock:
            return self._holders.setdefault(cam, holder) is holder

    def let_go(self, cam: str, holder: object) -> None:
        """Give it back; harmless when another has it."""
        with self._lock:
            if self._holders.get(cam) is holder:
                del self._holders[cam]

    def fire(self, cam: str) -> Pulse:
        """Make a pulse; a camera that is not the first joins the newest one if it has not used it yet."""
        with self._lock:
            now = time.monotonic_ns()
            pulse = self._newest
            is_first = cam <= min(self._last_of, default=cam)
            is_used = self._last_of.get(cam, 0) >= pulse.number
            if is_first or is_used or now - pulse.at_ns > _SAME_PULSE_S * 1e9:
                pulse = self._newest = Pulse(pulse.number + 1, now)
            self._last_of[cam] = pulse.number
            return pulse


_lines: weakref.WeakKeyDictionary[Any, TriggerLine] = weakref.WeakKeyDictionary()
_lines_lock = threading.Lock()


def _line_of(world: Exposer) -> TriggerLine:
    with _lines_lock:
        return _lines.setdefault(world, TriggerLine())


class SimFrameGrabber:
    """A simulated camera; see `stereorig.drivers.cameras.protocol.FrameGrabber`.

    Parameters
    ----------
    world
        The world that renders the images. Cameras of one world share one trigger line.
    cam
        Name of the camera.
    image_size_px, bit_depth
        Width and height, and significant bits; taken from the world's rig when left out.
    line
        Another trigger line than the world's own.
    seed
        Seed of the noise; each camera draws its own.
    sequence_bits, first_sequence
        Width of the frame counter and its first value, to meet its wrap.
    latency_s
        Longest time of rendering: the watchdog must allow for it.
    """

    def __init__(
        self,
        world: Exposer,
        cam: CameraName,
        *,
        image_size_px: tuple[int, int] | None = None,
        bit_depth: int | None = None,
        line: TriggerLine | None = None,
        seed: int = 0,
        sequence_bits: int = 16,
        first_sequence: int = 0,
        latency_s: float = 30.0,
    ) -> None:
        if image_size_px is None or bit_depth is None:
            known = world.rig.camera(cam)  # type: ignore[attr-defined]  # a bare Exposer must be described by the caller
            image_size_px = image_size_px or known.size_px
            bit_depth = bit_depth or known.sensor.bit_depth
        self._world = world
        self._cam: CameraName = cam
        self._line = line if line is not None else _line_of(world)
        self.faults = self._line.faults_of(cam)
        self._rng = np.random.default_rng([seed, int(cam[-1])])
        self._sequence_bits = sequence_bits
        self._counter = itertools.count(first_sequence)
        self._description = CameraDescription(
            model="simulated camera",
            serial=f"SIM-{cam}",
            image_size_px=image_size_px,
            bit_depths=(bit_depth,),
            trigger_modes=("free", "software", "hardware"),
            exposure_range_ms=(0.01, 1000.0),
            gain_range_db=(0.0, 24.0),
            frame_rate_range_hz=(0.1, 400.0),
            driver="sim",
            latency_s=latency_s,
            clock="sim",
            counter_range=(0, 2**sequence_bits - 1),
        )
        self._settings = CameraSettings(
            exposure_ms=10.0,
            gain_db=0.0,
            frame_rate_hz=10.0,
            bit_depth=bit_depth,
            trigger="software",
            region_px=(0, 0, *image_size_px),
        )
        self._open = False
        self._exposed = 0
        self._orders: queue.SimpleQueue[Pulse | None] = queue.SimpleQueue()
        self._frames: queue.Queue[Frame | CameraError] = queue.Queue(_RING)
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()

    def open(self) -> None:
        """Connect."""
        self._check_there()
        if self.faults.busy or not self._line.hold(self._cam, self):
            raise CameraError(
                f"Another program holds {self._cam}.",
                code="camera_busy",
                remedy="Close the other program, then reconnect.",
                camera=self._cam,
            )
        self._open = True

    def describe(self) -> CameraDescription:
        """Return the camera's identity."""
        self._check_there()
        return self._description

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the values that are not ``None``; refuse all of them if one cannot be set."""
        self._check_open()
        here = self._description
        for name, value, allowed in (
            ("exposure_ms", settings.exposure_ms, here.exposure_range_ms),
            ("gain_db", settings.gain_db, here.gain_range_db),
            ("frame_rate_hz", settings.frame_rate_hz, here.frame_rate_range_hz),
        ):
            low, high = allowed or (-np.inf, np.inf)
            if value is not None and not low <= value <= high:  # NaN is in no range
                raise self._out_of_range(name, value, f"{low:g} to {high:g}")
        if settings.features or settings.pixel_format is not None:
            names = [*(settings.features or ())] or [f"pixel_format {settings.pixel_format}"]
            raise CameraError(
                f"{self._cam} has no {', '.join(names)}.",
                code="unknown_feature",
                remedy="A simulated camera has exposure, gain, frame rate, trigger and region only.",
                camera=self._cam,
            )
        if settings.bit_depth is not None and settings.bit_depth not in here.bit_depths:
            raise self._out_of_range("bit_depth", settings.bit_depth, f"{here.bit_depths}")
        if settings.trigger is not None and settings.trigger not in here.trigger_modes:
            raise self._out_of_range("trigger", settings.trigger, f"{here.trigger_modes}")
        if settings.region_px is not None:
            columns, rows = here.image_size_px
            x0, y0, width, height = settings.region_px
            if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > columns or y0 + height > rows:
                raise self._out_of_range("region_px", settings.region_px, f"inside {columns} x {rows} px")
        given = {name: value for name, value in vars(settings).items() if value is not None}
        self._settings = replace(self._settings, **given)
        return self._settings

    def arm(self) -> None:
        """Start delivering."""
        self._check_open()
        if self._thread is not None:
            return
        self._ending = threading.Event()
        self._orders = queue.SimpleQueue()
        rate_hz = self._settings.frame_rate_hz or 0.0
        self._frames = queue.Queue(round(_BEHIND_S * rate_hz) if rate_hz > _FRESH_HZ else _RING)
        self._thread = threading.Thread(target=self._run, name=f"simulated {self._cam}", daemon=True)
        self._thread.start()
        if self._settings.trigger == "hardware":
            self._line.listen(self._cam, self._orders)

    def disarm(self) -> None:
        """Stop delivering; an exposure in progress is finished and discarded."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._line.listen(self._cam, None)
            self._ending.set()
            self._orders.put(None)
            thread.join()

    def trigger(self) -> int | None:
        """Fire the common trigger line; returns the number of the pulse."""
        self._check_open()
        if self._settings.trigger != "software":
            raise CameraError(
                f"{self._cam} is in trigger mode {self._settings.trigger!r}, not 'software'.",
                code="wrong_trigger",
                remedy="Set trigger to 'software' first.",
                camera=self._cam,
            )
        if self._thread is None:
            raise CameraError(
                f"{self._cam} is not armed.",
                code="not_armed",
                remedy="Arm it before it is triggered.",
                camera=self._cam,
            )
        pulse = self._line.fire(self._cam)
        self._orders.put(pulse)
        return pulse.number

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_open()
            left = deadline - time.monotonic()
            try:
                item = self._frames.get(timeout=min(max(left, 0.0), 0.05))
            except queue.Empty:
                if left <= 0:
                    return None
                continue
            if isinstance(item, CameraError):
                raise item
            return item

    def statistics(self) -> dict[str, int | float]:
        """Frames exposed since the camera was made."""
        return {"exposed": self._exposed}

    def close(self) -> None:
        """Release the camera."""
        self._open = False
        self._line.let_go(self._cam, self)
        self.disarm()

    def _run(self) -> None:
        ending, orders, frames = self._ending, self._orders, self._frames
        number = itertools.count(1)
        due = time.monotonic()
        # a real camera needs no processor of the host; rendering must not take it from the frames' handling
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while not ending.is_set():
            if self._settings.trigger != "free":
                order = orders.get()
                if order is None:
                    return
                pulse, trigger = order, order.number if self._settings.trigger == "software" else None
            else:
                rate_hz, now = self._settings.frame_rate_hz or 10.0, time.monotonic()
                if rate_hz <= _FRESH_HZ:
                    due = max(due + 1.0 / rate_hz, now)
                else:  # a real camera exposes on time however late its host is
                    due = max(round(due * rate_hz) + 1, math.ceil((now - _BEHIND_S) * rate_hz)) / rate_hz
                if ending.wait(max(0.0, due - time.monotonic())):
                    return
                at_ns = time.monotonic_ns() if rate_hz <= _FRESH_HZ else round(1e9 * due)
                pulse, trigger = Pulse(next(number), at_ns), None
            if not self.faults.gone:
                self._expose(pulse, trigger, ending, frames)

    def _expose(
        self, pulse: Pulse, trigger: int | None, ending: threading.Event, frames: queue.Queue[Frame | CameraError]
    ) -> None:
        sequence = next(self._counter) % 2**self._sequence_bits
        self._exposed += 1
        if self.faults.drop > 0:
            self.faults.drop -= 1
            return
        try:
            pixels = self._world.expose(
                self._cam,
                exposure_ms=self._settings.exposure_ms or 10.0,
                gain_db=self._settings.gain_db or 0.0,
                rng=self._rng,
                **({"again": True} if (self._settings.frame_rate_hz or 0.0) > _FRESH_HZ else {}),
            )
        except Exception as error:  # noqa: BLE001  # reported to the thread's owner, whatever it was
            fault = CameraError(f"{self._cam} made no image: {error}", remedy="Check the simulated scene.")
            fault.__cause__ = error
            self._put(fault, frames)
            return
        if ending.is_set() or self.faults.silent:
            return
        if self._settings.region_px is not None:
            x0, y0, width, height = self._settings.region_px
            pixels = pixels[y0 : y0 + height, x0 : x0 + width]
        status = FrameStatus.OK
        if self.faults.incomplete > 0:
            self.faults.incomplete -= 1
            status = FrameStatus.INCOMPLETE
            pixels = pixels.copy()
            pixels[pixels.shape[0] // 2 :] = 0
        device_ns = pulse.at_ns + round(self.faults.skew_ms * 1e6)
        frame = Frame(
            pixels, self._description.bit_depths[0], sequence, device_ns, time.monotonic_ns(), status, trigger
        )
        self._put(frame, frames)
        if self.faults.duplicate > 0:
            self.faults.duplicate -= 1
            self._put(replace(frame, host_ns=time.monotonic_ns()), frames)

    @staticmethod
    def _put(item: Frame | CameraError, frames: queue.Queue[Frame | CameraError]) -> None:
        while True:
            try:
                frames.put_nowait(item)
            except queue.Full:
                # the ring runs over: the oldest is lost, which the gap in the frame numbers shows
                try:
                    frames.get_nowait()
                except queue.Empty:
                    continue
            else:
                return

    def _check_there(self) -> None:
        if self.faults.gone:
            raise CameraError(
                f"{self._cam} is gone.", code="camera_lost", remedy="Check its cable, then reconnect.", camera=self._cam
            )

    def _check_open(self) -> None:
        self._check_there()
        if not self._open:
            raise CameraError(
                f"{self._cam} is not open.", code="camera_lost", remedy="Connect the camera first.", camera=self._cam
            )

    def _out_of_range(self, name: str, value: object, allowed: str) -> CameraError:
        return CameraError(
            f"{self._cam} cannot set {name} to {value!r}, only {allowed}.",
            code="out_of_range",
            remedy="Give a value in the range above.",
            camera=self._cam,
            setting=name,
        )
