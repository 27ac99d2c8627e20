"""Names of the two cameras and of the parts of an uncertainty, as spelled in files, messages and replies."""

from __future__ import annotations

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
