"""Names of the two cameras and of the parts of an uncertainty, as spelled in files, messages and replies."""

from __future__ import annotations

from typing import Literal, get_args

CameraName = Literal["cam1", "cam2"]
CAMERAS: tuple[CameraName, CameraName] = ("cam1", "cam2")

Cause = Literal["calibration", "stage", "target"]
"""Of what all points of a result share: noise of the calibration's views (and all that is not told apart), priors of
the stage's steps, scale and tilt, the target's pitch and node errors."""
CAUSES: tuple[Cause, ...] = get_args(Cause)

BudgetName = Literal["matching", "reference", "calibration", "stage", "target"]
"""Parts of a budget: the points' own noise that is new at each step, that of the reference pair, and the causes."""
BUDGET: tuple[BudgetName, ...] = get_args(BudgetName)
