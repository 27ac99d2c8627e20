"""Errors common to all stage drivers: wrong states, and values for which no byte is sent."""

from __future__ import annotations

import math

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import AxisLimits, AxisOptions


def configuration_state(axis: int) -> StageError:
    """Return the error of an axis that was left in the SMC100's configuration state."""
    return StageError(
        f"Axis {axis} is in CONFIGURATION state, in which a program left it (PW1): it refuses every motion.",
        code="configuration_state",
        remedy="Finish what that program began, or leave the state on purpose, which writes the controller's flash "
        "memory (it bears about a hundred writes): POST /stage/axes/N:leave-configuration.",
        axis=axis,
    )


def not_in_configuration(axis: int) -> StageError:
    """Return the error of an axis that is not in its configuration state."""
    return StageError(
        f"Axis {axis} is not in CONFIGURATION state.",
        code="not_in_configuration",
        remedy="There is nothing to leave; read the axis' state.",
        axis=axis,
    )


def unit_not_length(axis: int, url: str, unit: str, remedy: str) -> StageError:
    """Return the error of an axis that counts in a unit that is no length."""
    return StageError(
        f"Axis {axis} of {url} counts in {unit}, which is no length.", code="unit_not_length", remedy=remedy, axis=axis
    )


def no_travel(axis: int, url: str) -> StageError:
    """Return the error of an axis whose travel neither its controller nor the rig file limits."""
    return StageError(
        f"Axis {axis} has no limits: neither the controller {url} nor the rig file gives any.",
        code="out_of_limits",
        remedy="Set soft_limits_mm in the rig file.",
        axis=axis,
    )


def check_dynamic(axis: int, quantity: str, value: object, maximum: float | None) -> None:
    """Raise an error for a velocity or an acceleration that is no positive number or above the controller's greatest.

    Raises
    ------
    StageError
        ``out_of_range``.
    """
    fine = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    if fine and (maximum is None or value <= maximum):  # type: ignore[operator]
        return
    limit = "" if maximum is None else f" up to {maximum:g}"
    raise StageError(
        f"Axis {axis} cannot have the {quantity} {value!r}: not a number above 0{limit} (mm, s).",
        code="out_of_range",
        remedy="Give a value that the stage can do.",
        axis=axis,
    )


def not_homed(axis: int) -> StageError:
    """Return the error of an axis whose position is not known."""
    return StageError(
        f"Axis {axis} was not homed, its position means nothing.",
        code="not_homed",
        remedy="Home the axis first.",
        axis=axis,
    )


def motor_off(axis: int) -> StageError:
    """Return the error of an axis without power."""
    return StageError(f"The motor of axis {axis} is off.", code="motor_off", remedy="Enable the axis first.", axis=axis)


def motion_fault(axis: int, failure: str) -> StageError:
    """Return the error of a motion that failed."""
    return StageError(
        f"Axis {axis} {failure}.",
        code="motion_fault",
        remedy="Check the stage for an obstacle or a limit switch, enable and home it, then move again.",
        axis=axis,
    )


def check_number(axis: int, value: object) -> float:
    """Return a position or a distance, or raise ``out_of_limits`` if it is no finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise StageError(
            f"Axis {axis} cannot move to {value!r}: not a finite number.",
            code="out_of_limits",
            remedy="Give a target in millimetres inside the limits.",
            axis=axis,
        )
    return float(value)


def check_target(axis: int, target: object, limits: AxisLimits) -> float:
    """Return a target, or raise ``out_of_limits`` at one outside the limits."""
    goal = check_number(axis, target)
    if not limits.low_mm <= goal <= limits.high_mm:
        raise StageError(
            f"Axis {axis} cannot move to {goal:g} mm: outside {limits.low_mm:g} to {limits.high_mm:g} mm.",
            code="out_of_limits",
            remedy="Give a target inside the limits, or widen the soft limits in the rig file.",
            axis=axis,
            target_mm=goal,
            low_mm=limits.low_mm,
            high_mm=limits.high_mm,
        )
    return goal


def detour(axis: int, option: AxisOptions, limits: AxisLimits, here_mm: float, goal_mm: float) -> float | None:
    """Return the intermediate target that takes up the backlash; ``None`` when the direct way does."""
    sign = 1.0 if option.approach_from == "below" else -1.0
    if option.backlash_mm == 0 or sign * (goal_mm - here_mm) >= option.backlash_mm:
        return None
    turn = goal_mm - sign * option.backlash_mm
    if not limits.low_mm <= turn <= limits.high_mm:
        raise StageError(
            f"Axis {axis} cannot arrive at {goal_mm:g} mm from {option.approach_from}: it would have to turn at "
            f"{turn:g} mm, outside {limits.low_mm:g} to {limits.high_mm:g} mm.",
            code="out_of_limits",
            remedy=f"Stay at least the backlash ({option.backlash_mm:g} mm) inside the limit.",
            axis=axis,
            target_mm=goal_mm,
        )
    return turn


def tighten(axis: int, soft: tuple[float, float] | None, low_mm: float, high_mm: float) -> AxisLimits:
    """Return the limits of controller and rig file together, or raise ``out_of_limits`` when no travel is left."""
    low, high = (low_mm, high_mm) if soft is None else (max(low_mm, soft[0]), min(high_mm, soft[1]))
    if not low < high:
        raise StageError(
            f"The soft limits {soft} mm of axis {axis} leave nothing of its travel {low_mm:g} to {high_mm:g} mm.",
            code="out_of_limits",
            remedy="Correct soft_limits_mm in the rig file.",
            axis=axis,
        )
    return AxisLimits(low, high, low_mm, high_mm)
