"""Simulated controllers by the names of their drivers, as rig files give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from stereorig.core.errors import StageError
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.smc100 import Model, SimSMC100
from stereorig.sim.controllers.wire import Motion


def make_controller(driver: str, axes: Sequence[int], **motion: Unpack[Motion]) -> SimESP301 | SimSMC100:
    """Make the controller that a driver expects, with the axes that a rig names.

    Parameters
    ----------
    driver
        ``esp301``, ``smc100`` or ``conex-cc``; a wrong one raises `StageError` with code ``unknown_driver``.
    axes
        Axis numbers; addresses for the SMC100 and the CONEX-CC.
    **motion
        See `stereorig.sim.controllers.wire.Motion`.
    """
    if driver == "esp301":
        return SimESP301(axes=max(axes), **motion)
    models: dict[str, Model] = {"smc100": "SMC100CC", "conex-cc": "CONEX-CC"}
    if driver in models:
        return SimSMC100(model=models[driver], addresses=tuple(axes), **motion)
    raise StageError(
        f"There is no simulated controller for the driver {driver!r}, only for esp301, smc100 and conex-cc.",
        code="unknown_driver",
        remedy="Correct [stage] driver in the rig file.",
    )
