"""Simulated controllers by the names of their drivers, as rig files give them."""

from __future__ import annotations

from collections.abc import Sequence

from core.errors import StageError
from sim.controllers.esp301 import SimESP301
from sim.controllers.smc100 import Model, SimSMC100


def make_controller(
    driver: str,
    axes: Sequence[int],
    *,
    travel_mm: tuple[float, float] = (-50.0, 50.0),
    velocity_mm_s: float = 10.0,
    acceleration_mm_s2: float = 40.0,
    time_scale: float = 1.0,
    start_mm: float = 0.0,
) -> SimESP301 | SimSMC100:
    """Make the controller that a driver expects, with the axes that a rig names.

    Parameters
    ----------
    driver
        ``esp301``, ``smc100`` or ``conex-cc``; a wrong one raises `StageError` with code ``unknown_driver``.
    axes
        Axis numbers; addresses for the SMC100 and the CONEX-CC.
    travel_mm, velocity_mm_s, acceleration_mm_s2, time_scale, start_mm
        As in `SimESP301`; velocities up to four times ``velocity_mm_s`` can be set.
    """
    if driver == "esp301":
        return SimESP301(
            axes=max(axes),
            travel_mm=travel_mm,
            velocity_mm_s=velocity_mm_s,
            acceleration_mm_s2=acceleration_mm_s2,
            time_scale=time_scale,
            start_mm=start_mm,
        )
    models: dict[str, Model] = {"smc100": "SMC100CC", "conex-cc": "CONEX-CC"}
    if driver in models:
        return SimSMC100(
            model=models[driver],
            addresses=tuple(axes),
            travel_mm=travel_mm,
            velocity_mm_s=velocity_mm_s,
            acceleration_mm_s2=acceleration_mm_s2,
            time_scale=time_scale,
            start_mm=start_mm,
        )
    raise StageError(
        f"There is no simulated controller for the driver {driver!r}, only for esp301, smc100 and conex-cc.",
        code="unknown_driver",
        remedy="Correct [stage] driver in the rig file.",
    )
