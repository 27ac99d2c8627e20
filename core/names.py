"""Names of cameras, uncertainty parts and live gauges' quantities, as spelled in files, messages and replies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

CameraName = Literal["cam1", "cam2"]
CAMERAS: tuple[CameraName, CameraName] = ("cam1", "cam2")

Cause = Literal["calibration", "stage", "target", "sensor"]
"""Causes that all points of a result share: noise of the calibration's views (and all parts not known separately),
priors of the stage's steps, scale and tilt, the target's pitch and node errors; and the pull of a sensor's fixed
pattern.
"""
CAUSES: tuple[Cause, ...] = ("calibration", "stage", "target")
"""Causes of a calibration."""
ALL_CAUSES: tuple[Cause, ...] = (*CAUSES, "sensor")

BudgetName = Literal["matching", "reference", "calibration", "stage", "target", "sensor"]
"""Parts of a budget: the points' own noise that is new at each step, the reference pair's noise, and the causes."""
BUDGET: tuple[BudgetName, ...] = ("matching", "reference", "calibration", "stage", "target")
ALL_PARTS: tuple[BudgetName, ...] = (*BUDGET, "sensor")

GaugeKind = Literal["point", "extensometer", "area"]
UNITS: Mapping[GaugeKind, Mapping[str, str]] = {
    "point": {"u_mm": "mm", "v_mm": "mm", "w_mm": "mm"},
    "extensometer": {"length0_mm": "mm", "length_mm": "mm", "elongation_mm": "mm", "strain": "1", "true_strain": "1"},
    "area": {"u_mm": "mm", "v_mm": "mm", "w_mm": "mm", "exx": "1", "eyy": "1", "exy": "1"},
}
"""The quantities of each kind of live gauge, with their units."""
