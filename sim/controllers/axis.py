"""One simulated axis: positions of its motor and of the load that the motor pushes, at any moment.

The encoder sits on the motor. Between the motor and the load are the errors of a real stage: lost motion, a wrong screw
pitch and a misaligned axis. Controllers report the encoder, the simulated world uses the load.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Literal


class SimClock:
    """Seconds that pass ``time_scale`` times faster than the wall's."""

    def __init__(self, time_scale: float = 1.0) -> None:
        if not time_scale > 0:
            raise ValueError(f"time_scale must be positive, got {time_scale}")
        self.time_scale = time_scale
        self._start = time.monotonic()

    def now(self) -> float:
        """Return simulated seconds since the clock was made."""
        return (time.monotonic() - self._start) * self.time_scale


@dataclass(frozen=True)
class Ramp:
    """A stretch of constant acceleration, from ``start_s`` on for ``duration_s``."""

    start_s: float
    duration_s: float
    position_mm: float
    velocity_mm_s: float
    acceleration_mm_s2: float

    def at(self, now_s: float) -> tuple[float, float]:
        """Return position and velocity."""
        t = min(max(now_s - self.start_s, 0.0), self.duration_s)
        velocity = self.velocity_mm_s + self.acceleration_mm_s2 * t
        return self.position_mm + (self.velocity_mm_s + velocity) / 2 * t, velocity


@dataclass(frozen=True)
class MotionProfile:
    """Segments one after the other; at rest at ``goal_mm`` from ``end_s`` on."""

    segments: tuple[Ramp, ...]
    goal_mm: float
    end_s: float

    def at(self, now_s: float) -> tuple[float, float]:
        """Return position and velocity."""
        if now_s >= self.end_s:
            return self.goal_mm, 0.0
        for segment in reversed(self.segments):
            if now_s >= segment.start_s:
                return segment.at(now_s)
        return self.segments[0].at(now_s)


def trapezoid(start_mm: float, goal_mm: float, now_s: float, velocity_mm_s: float, ramp_mm_s2: float) -> MotionProfile:
    """Plan a move from rest to rest: ramp up, cruise, ramp down."""
    distance = abs(goal_mm - start_mm)
    sign = math.copysign(1.0, goal_mm - start_mm)
    peak = min(velocity_mm_s, math.sqrt(distance * ramp_mm_s2))
    if distance == 0 or peak == 0:
        return MotionProfile((), goal_mm, now_s)
    ramp_s = peak / ramp_mm_s2
    cruise_s = max(0.0, distance / peak - ramp_s)
    lead = sign * peak * ramp_s / 2
    return MotionProfile(
        (
            Ramp(now_s, ramp_s, start_mm, 0.0, sign * ramp_mm_s2),
            Ramp(now_s + ramp_s, cruise_s, start_mm + lead, sign * peak, 0.0),
            Ramp(now_s + ramp_s + cruise_s, ramp_s, goal_mm - lead, sign * peak, -sign * ramp_mm_s2),
        ),
        goal_mm,
        now_s + 2 * ramp_s + cruise_s,
    )


def brake(position_mm: float, velocity_now_mm_s: float, now_s: float, ramp_mm_s2: float) -> MotionProfile:
    """Plan to come to rest as soon as the ramp allows."""
    duration = abs(velocity_now_mm_s) / ramp_mm_s2
    goal = position_mm + velocity_now_mm_s * duration / 2
    ramp = -math.copysign(ramp_mm_s2, velocity_now_mm_s)
    return MotionProfile((Ramp(now_s, duration, position_mm, velocity_now_mm_s, ramp),), goal, now_s + duration)


@dataclass
class AxisFaults:
    """Faults of an axis; every value may be set while it runs.

    Attributes
    ----------
    backlash_mm
        Lost motion between motor and load. A load that was last pushed upwards is at the motor's position.
    scale_error
        The load moves ``1 + scale_error`` times the encoder's motion (a wrong screw pitch).
    tilt
        Sideways motion of the load per mm along the axis, in two directions across it (misalignment, in rad).
    jam_mm
        ``(low, high)``: the motor cannot leave this range.
    jam_kind
        Effect of a jam on the controller: ``following_error`` (it trips), or ``silent`` (the motion ends without an
        error).
    limit_switches_mm
        ``(low, high)`` positions of the hardware limit switches.
    """

    backlash_mm: float = 0.0
    scale_error: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    jam_mm: tuple[float, float] | None = None
    jam_kind: Literal["following_error", "silent"] = "following_error"
    limit_switches_mm: tuple[float, float] | None = None


Trouble = Literal["following_error", "positive_limit", "negative_limit"]


class SimAxis:
    """Motor, encoder and load of one axis, in mm and simulated seconds. Thread-safe.

    Parameters
    ----------
    clock
        Shared by all axes of one controller.
    velocity_mm_s, acceleration_mm_s2
        Velocity and acceleration of moves, until changed.
    resolution_mm
        One encoder count.
    start_mm
        Position of the motor at power-on, measured from home; the encoder reads 0 there until homed.
    """

    def __init__(
        self,
        clock: SimClock,
        *,
        velocity_mm_s: float = 10.0,
        acceleration_mm_s2: float = 40.0,
        resolution_mm: float = 1e-4,
        start_mm: float = 0.0,
    ) -> None:
        self.clock = clock
        self.velocity_mm_s = velocity_mm_s
        self.acceleration_mm_s2 = acceleration_mm_s2
        self.resolution_mm = resolution_mm
        self.faults = AxisFaults()
        self._lock = threading.RLock()
        self._offset_mm = start_mm  # motor position at which the encoder reads 0
        self._motor_mm = start_mm
        self._load_mm = start_mm
        self._profile = MotionProfile((), start_mm, -math.inf)
        self._trouble: Trouble | None = None

    def move_to(self, encoder_mm: float) -> None:
        """Start a move to an encoder position; replaces a motion in progress."""
        with self._lock:
            now = self._advance()
            self._profile = trapezoid(
                self._motor_mm, encoder_mm + self._offset_mm, now, self.velocity_mm_s, self.acceleration_mm_s2
            )

    def move_home(self) -> None:
        """Start a move to the home switch."""
        with self._lock:
            now = self._advance()
            self._profile = trapezoid(self._motor_mm, 0.0, now, self.velocity_mm_s, self.acceleration_mm_s2)

    def set_home(self) -> None:
        """Let the encoder read 0 at the home switch from now on."""
        with self._lock:
            self._offset_mm = 0.0

    def define_position(self, encoder_mm: float) -> None:
        """Let the encoder read this value at the motor's present position."""
        with self._lock:
            self._advance()
            self._offset_mm = self._motor_mm - encoder_mm

    def stop(self) -> None:
        """Come to rest on the ramp."""
        with self._lock:
            now = self._advance()
            _, velocity = self._profile.at(now)
            if velocity != 0:
                self._profile = brake(self._motor_mm, velocity, now, self.acceleration_mm_s2)

    def cut(self) -> None:
        """Stop at once, as with the motor switched off."""
        with self._lock:
            self._advance()
            self._profile = MotionProfile((), self._motor_mm, -math.inf)

    @property
    def moving(self) -> bool:
        """True during a motion."""
        with self._lock:
            return self._advance() < self._profile.end_s

    @property
    def encoder_mm(self) -> float:
        """Encoder position as the controller reads it, rounded to counts."""
        with self._lock:
            self._advance()
            return round((self._motor_mm - self._offset_mm) / self.resolution_mm) * self.resolution_mm

    @property
    def velocity_now_mm_s(self) -> float:
        """Speed of the present motion."""
        with self._lock:
            return self._profile.at(self._advance())[1]

    @property
    def goal_mm(self) -> float:
        """Encoder position at which the present motion ends."""
        with self._lock:
            return self._profile.goal_mm - self._offset_mm

    def true_position_mm(self) -> float:
        """Position of the load along its axis, measured from home."""
        with self._lock:
            self._advance()
            return self._load_mm * (1.0 + self.faults.scale_error)

    def true_displacement_mm(self) -> tuple[float, float, float]:
        """Position of the load in space: across, across, along; measured from home."""
        along = self.true_position_mm()
        return (self.faults.tilt[0] * along, self.faults.tilt[1] * along, along)

    def take_trouble(self) -> Trouble | None:
        """Return the fault since the last call, if any."""
        with self._lock:
            self._advance()
            trouble, self._trouble = self._trouble, None
            return trouble

    def _advance(self) -> float:
        now = self.clock.now()
        wanted, _ = self._profile.at(now)
        motor = wanted
        if self.faults.jam_mm is not None:
            motor = min(max(motor, self.faults.jam_mm[0]), self.faults.jam_mm[1])
            if motor != wanted and self.faults.jam_kind == "following_error":
                self._trouble = "following_error"
                self._profile = MotionProfile((), motor, -math.inf)
        switches = self.faults.limit_switches_mm
        if switches is not None and not switches[0] <= motor <= switches[1] and motor != self._motor_mm:
            self._trouble = "positive_limit" if motor > switches[1] else "negative_limit"
            motor = min(max(motor, switches[0]), switches[1])
            self._profile = MotionProfile((), motor, -math.inf)
        self._motor_mm = motor
        # A load with play: the motor pushes it upwards at once, downwards only after the lost motion. Motion between
        # two calls has one direction, so this is exact for any interval between calls.
        self._load_mm = min(max(self._load_mm, motor), motor + self.faults.backlash_mm)
        return now
