"""What the camera contract needs of a backend: two cameras, and hands that pull their cables.

Each backend gives one `CameraBench`. The contract asks only through it, so that the same tests run over the simulated
cameras, over Aravis with two fake GigE cameras, over pylon with its emulator, and over V4L2 with the kernel's vivid
driver in a virtual machine.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.core.names import CameraName
from stereorig.drivers.acquisition.frame_counter import SequenceReader
from stereorig.drivers.acquisition.reader import CameraReader
from stereorig.drivers.cameras.protocol import CameraSettings, Frame, FrameGrabber, Pixels, TriggerMode
from stereorig.sim.grabber import SimFrameGrabber, TriggerLine
from tests.support.patience import Deadline, busy

#: set inside the virtual machine, where only the V4L2 part of the contract runs
IN_GUEST = "STEREORIG_V4L2_GUEST"

#: backend -> ways in which it can lose a camera
LOSSES: dict[str, tuple[str, ...]] = {
    "sim": ("gone", "silent"),
    "aravis": ("killed", "stopped", "cable"),
    "pylon": ("removed",),
    "v4l2": ("unplugged", "io_error"),
}

#: backend -> what else can go wrong with it: see `CameraBench.spoil`
SPOILS: dict[str, tuple[str, ...]] = {
    "sim": ("drop", "duplicate", "incomplete", "wrap"),
    "aravis": ("incomplete", "wrap"),
    "pylon": ("incomplete",),
    "v4l2": ("drop", "incomplete", "wrap"),
}


def backends() -> tuple[str, ...]:
    """Those that run here."""
    return ("v4l2",) if os.environ.get(IN_GUEST) else ("sim", "aravis", "pylon")


class CameraBench(ABC):
    """Two cameras of one backend.

    Attributes
    ----------
    name
        A key of `LOSSES`.
    rate_hz
        A frame rate that the backend surely reaches in free run.
    triggers
        Modes in which the bench can make a frame come.
    region_px
        A region that the cameras can be set to, or None where they know the whole image only.
    first_region_px
        The region that the contract begins with; None leaves the camera's own.
    """

    name: str
    rate_hz: float = 20.0
    triggers: tuple[TriggerMode, ...] = ("free", "software")
    region_px: tuple[int, int, int, int] | None = None
    first_region_px: tuple[int, int, int, int] | None = None

    @abstractmethod
    def make(self, cam: CameraName) -> FrameGrabber:
        """A new grabber of that camera, not opened."""

    @abstractmethod
    def lose(self, cam: CameraName, how: str) -> None:
        """Take the camera away, in one of the ways of `LOSSES`."""

    @abstractmethod
    def bring_back(self, cam: CameraName) -> None:
        """Make it reachable again; returns when it is."""

    @abstractmethod
    def spoil(self, cam: CameraName, what: str, grabber: FrameGrabber) -> None:
        """Begin a disturbance of an armed camera, in one of the ways of `SPOILS`.

        ``wrap`` makes the frame counter wrap within the next seconds; the others spoil a share of the frames, or some.
        """

    @abstractmethod
    def reset(self) -> None:
        """Bring both cameras back to how they were before the first test; called after each one."""


class _Corridor:
    """A world of noise alone, so that no two frames are alike."""

    def expose(self, cam: CameraName, *, exposure_ms: float, gain_db: float, rng: np.random.Generator | None) -> Pixels:
        assert rng is not None
        return rng.integers(0, 4000, size=(48, 64)).astype(np.uint16)


class SimBench(CameraBench):
    """Simulated cameras."""

    name = "sim"
    region_px = (8, 4, 32, 16)

    def __init__(self) -> None:
        self.world = _Corridor()
        self.line = TriggerLine()
        self.made: list[SimFrameGrabber] = []

    def make(self, cam: CameraName) -> FrameGrabber:
        grabber = SimFrameGrabber(
            self.world, cam, image_size_px=(64, 48), bit_depth=12, sequence_bits=6, line=self.line, latency_s=0.0
        )
        self.made.append(grabber)
        return grabber

    def lose(self, cam: CameraName, how: str) -> None:
        setattr(self.line.faults_of(cam), how, True)

    def bring_back(self, cam: CameraName) -> None:
        faults = self.line.faults_of(cam)
        faults.gone = faults.silent = False

    def spoil(self, cam: CameraName, what: str, grabber: FrameGrabber) -> None:
        assert isinstance(grabber, SimFrameGrabber)
        if what != "wrap":  # the counter has six bits: it wraps by itself
            setattr(grabber.faults, what, 2)  # three lost in a row would be silence

    def reset(self) -> None:
        for grabber in self.made:
            grabber.close()
        self.made.clear()
        self.line = TriggerLine()


def first_settings(bench: CameraBench, trigger: TriggerMode = "free") -> CameraSettings:
    """What the contract sets before it begins."""
    return CameraSettings(trigger=trigger, frame_rate_hz=bench.rate_hz, region_px=bench.first_region_px)


@contextmanager
def opened(bench: CameraBench, cam: CameraName, trigger: TriggerMode = "free") -> Iterator[FrameGrabber]:
    """A camera opened and configured, closed afterwards."""
    grabber = bench.make(cam)
    grabber.open()
    try:
        grabber.configure(first_settings(bench, trigger))
        yield grabber
    finally:
        grabber.close()


@contextmanager
def reading(
    bench: CameraBench, grabber: FrameGrabber, cam: CameraName, *, buffer_frames: int = 8, period_s: float | None = None
) -> Iterator[CameraReader]:
    """A reader in free run; a longer period than the camera's makes its watchdog more patient."""
    first, last = grabber.describe().counter_range
    reader = CameraReader(
        grabber,
        name=cam,
        period_s=1.0 / bench.rate_hz if period_s is None else period_s,
        expects_frames=True,
        buffer_frames=buffer_frames,
        sequence=SequenceReader(first, last),
    )
    reader.start()
    try:
        yield reader
    finally:
        reader.stop()


def frames_of(grabber: FrameGrabber, count: int, timeout_s: float = 5.0) -> list[Frame]:
    """The next frames of an armed camera, complete or not."""
    frames: list[Frame] = []
    deadline = Deadline(timeout_s)
    while len(frames) < count:
        assert deadline.left, f"{len(frames)} of {count} frames in {timeout_s} s"
        frame = grabber.next_frame(0.2)
        if frame is not None:
            frames.append(frame)
    return frames


def seconds_until(condition: Callable[[], bool], limit_s: float) -> float:
    """How long it takes; fails beyond the limit of a quiet machine, times its load."""
    begin = time.monotonic()
    while not condition():
        spent = time.monotonic() - begin
        assert spent < limit_s or spent < limit_s * busy(), f"waited {limit_s} s in vain"
        time.sleep(0.005)
    return time.monotonic() - begin


def opens(bench: CameraBench, cam: CameraName) -> FrameGrabber | None:
    """A new grabber, opened; None when the camera cannot be opened now."""
    grabber = bench.make(cam)
    try:
        grabber.open()
    except CameraError:
        grabber.close()
        return None
    return grabber
