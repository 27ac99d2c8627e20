"""The stage: its identity and state, the times of its answers and of its stop; motion only if it is allowed."""

from __future__ import annotations

import time

from stereorig.core.names import CAMERAS
from stereorig.drivers.stages.protocol import AxisState, Stage
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.doctor.report import Notebook, State, percentile

_QUERIES = 50
_STOPS = 20
#: on a slow line fewer do
_MAX_WAIT_S = 2.0
#: an answer later than this and the end of a motion is noticed late; stops share the line with it
_SLOW_ANSWER_MS = 100.0
#: the service's promise, from the request to the wire
_STOP_MS = 50.0
_STEP_MM = 0.1


def check_stage(book: Notebook, stage: Stage, config: RigConfig, *, move: bool, home: bool) -> None:
    """Look at every axis; ``home`` searches home, ``move`` makes a small move there and back."""
    with book.guard("stage", "identity"):
        who = stage.identify()
        axes = ", ".join(f"axis {a.axis} {a.model} {a.serial}".rstrip() for a in who.axes)
        book.note("stage", "identity", "ok", f"{who.model} {who.firmware} on {who.url}: {axes}")
    with book.guard("stage", "errors"):
        # read before any other question: these messages are older than this run
        messages = stage.errors()
        book.note(
            "stage",
            "errors",
            "warning" if messages else "ok",
            "; ".join(f"{m.text} ({m.code})" for m in messages) or "none waiting in the controller",
            remedy="The controller kept these from earlier; they are cleared now. Run the doctor again.",
        )
    if home:
        _home(book, stage)
    for axis in stage.axes:
        _check_axis(book, stage, config, axis)
    _check_answers(book, stage)
    _check_stop(book, stage)
    for axis in stage.axes:
        if move:
            with book.guard("stage", f"axis {axis} move"):
                _move(book, stage, config, axis)
        else:
            book.note(
                "stage",
                f"axis {axis} move",
                "not checked",
                "nothing moves on a real rig unless it is allowed",
                remedy="Give --move for a move of 0.1 mm and back, and --home to search home first.",
            )


def _home(book: Notebook, stage: Stage) -> None:
    for axis in stage.axes:
        with book.guard("stage", f"axis {axis} homing"):
            start = time.monotonic()
            stage.enable(axis)
            position = stage.home(axis)
            seconds = time.monotonic() - start
            book.note(
                "stage",
                f"axis {axis} homing",
                "ok",
                f"home found in {seconds:.1f} s, at {position:.4f} mm",
                seconds=seconds,
                position_mm=position,
            )


def _check_axis(book: Notebook, stage: Stage, config: RigConfig, axis: int) -> None:
    name = f"axis {axis}"
    with book.guard("stage", f"{name} state"):
        status = stage.state(axis)
        limits = stage.limits(axis)
        remedies = {
            AxisState.NOT_HOMED: "POST /stage:home before it is used, or give --home here.",
            AxisState.MOTOR_OFF: "POST /stage:home, or /stage:enable if it was homed; or give --home here.",
            AxisState.CONFIGURATION: f"POST /stage/axes/{axis}:leave-configuration, after a look at "
            "docs/how_to/stages.md.",
        }
        state: State = "warning"
        if status.state in (AxisState.READY, AxisState.FAULT):
            state = "ok" if status.state is AxisState.READY else "failed"
        book.note(
            "stage",
            f"{name} state",
            state,
            f"{status.state.value}, at {status.position_mm:.4f} mm {status.detail}".rstrip(),
            limit="ready",
            remedy=remedies.get(
                status.state, "Put right the faults that the controller names, then run the doctor again."
            ),
            position_mm=status.position_mm,
        )
        outside = _outside(config, axis, limits.low_mm, limits.high_mm)
        book.note(
            "stage",
            f"{name} limits",
            "failed" if outside else "ok",
            f"{limits.low_mm:g} to {limits.high_mm:g} mm (controller {limits.controller_low_mm:g} to "
            f"{limits.controller_high_mm:g} mm)" + (f"; {outside}" if outside else ""),
            limit="the calibration's positions",
            remedy="Correct soft_limits_mm, zero_mm or the [calibration] plan in the rig file.",
            low_mm=limits.low_mm,
            high_mm=limits.high_mm,
        )


def _outside(config: RigConfig, axis: int, low_mm: float, high_mm: float) -> str:
    """Say which positions of the calibration plan this axis cannot reach from the side that it has to."""
    section, plan = config.axis(axis), config.calibration
    turn = section.backlash_mm * (-1.0 if section.approach_from == "below" else 1.0)
    bad = []
    for cam in CAMERAS:
        camera = config.camera(cam)
        for dz in (*plan.positions_mm, *plan.held_out_mm) if camera.stage_axis == axis else ():
            position = section.zero_mm + camera.stage_sign * dz
            if not (low_mm <= position <= high_mm and low_mm <= position + turn <= high_mm):
                bad.append(f"dZ {dz:g} mm of {cam}")
    return f"cannot reach {', '.join(bad)}" if bad else ""


def _check_answers(book: Notebook, stage: Stage) -> None:
    with book.guard("stage", "answers"):
        times = []
        end = time.perf_counter() + _MAX_WAIT_S
        for index in range(_QUERIES):
            start = time.perf_counter()
            if start > end:
                break
            stage.position(stage.axes[index % len(stage.axes)])
            times.append(1e3 * (time.perf_counter() - start))
        p99 = percentile(times, 0.99)
        book.note(
            "stage",
            "answers",
            "ok" if p99 <= _SLOW_ANSWER_MS else "warning",
            f"median {percentile(times, 0.5):.2f} ms, p99 {p99:.2f} ms ({len(times)} positions read)",
            limit=f"p99 {_SLOW_ANSWER_MS:g} ms",
            remedy="Check baud rate and adapter (an FTDI's latency_timer set to 1 ms), and the devices between.",
            median_ms=percentile(times, 0.5),
            p99_ms=p99,
        )


def _check_stop(book: Notebook, stage: Stage) -> None:
    """Time stops on axes that rest: a stop and the next answer. The answer can only follow the stop on the wire."""
    with book.guard("stage", "stop"):
        if any(stage.state(axis).moving for axis in stage.axes):
            book.note(
                "stage",
                "stop",
                "not checked",
                "an axis is moving",
                remedy="Let the motion end, then run the doctor again.",
            )
            return
        written, answered = [], []
        end = time.perf_counter() + _MAX_WAIT_S
        for _ in range(_STOPS):
            start = time.perf_counter()
            if start > end:
                break
            stage.stop()
            written.append(1e3 * (time.perf_counter() - start))
            stage.position(stage.axes[0])
            answered.append(1e3 * (time.perf_counter() - start))
        worst = percentile(answered, 0.99)
        book.note(
            "stage",
            "stop",
            "ok" if worst <= _STOP_MS else "warning",
            f"handed to the line in {percentile(written, 0.99):.2f} ms, at the controller within {worst:.2f} ms "
            f"(p99 of {len(written)}; the answer after it)",
            limit=f"{_STOP_MS:g} ms",
            remedy="Check baud rate and adapter; connect it without a network between.",
            written_p99_ms=percentile(written, 0.99),
            answered_p99_ms=worst,
        )
        messages = stage.errors()
        if messages:
            book.note(
                "stage",
                "stop errors",
                "warning",
                "; ".join(f"{m.text} ({m.code})" for m in messages),
                remedy="The controller refuses to be stopped in this state; home it first.",
            )


def _move(book: Notebook, stage: Stage, config: RigConfig, axis: int) -> None:
    name = f"axis {axis} move"
    status, limits = stage.state(axis), stage.limits(axis)
    if status.state is not AxisState.READY:
        book.note(
            "stage",
            name,
            "not checked",
            f"the axis is {status.state.value}",
            remedy="Give --home to search home first.",
        )
        return
    here = status.position_mm
    step = _STEP_MM if here < 0.5 * (limits.low_mm + limits.high_mm) else -_STEP_MM
    start = time.monotonic()
    there = stage.move_to(axis, here + step)
    back = stage.move_to(axis, here)
    worst = max(abs(there.position_mm - there.target_mm), abs(back.position_mm - back.target_mm))
    seconds = time.monotonic() - start
    tolerance = config.axis(axis).tolerance_mm
    book.note(
        "stage",
        name,
        "ok" if worst <= tolerance else "failed",
        f"{step:+g} mm and back in {seconds:.1f} s, read back within {1e3 * worst:.2f} um",
        limit=f"{1e3 * tolerance:g} um",
        remedy="Check the stage's load, backlash and tuning.",
        error_um=1e3 * worst,
        seconds=seconds,
    )
