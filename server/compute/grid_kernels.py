"""The kernels that find a line grid, run once on a grid drawn here: this loads or compiles them.

They are a calibration's first work, and so compiled first, at the same time as a measurement's.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.grid import detect_grid
from stereorig.core.target import GridTarget
from stereorig.server.compute.background_compilation import KernelsAside
from stereorig.server.worker.process import current_task

_LINES, _PITCH_PX, _SIGMA_PX, _ANGLE_RAD = 11, 28.0, 0.8, 0.6

grid_aside = KernelsAside("grid")
"""Started by the worker's warm-up if the kernels are not on disk."""


def await_grid_kernels(target: object) -> None:
    """Return once the kernels that find this target are compiled; a board's are compiled at their first use.

    Raises
    ------
    Cancelled
        The service asked for it.
    """
    if isinstance(target, GridTarget):
        grid_aside.wait(current_task())


def find_drawn_grid() -> None:
    """Find a grid of dark lines, turned about the image's middle."""
    half = 0.5 * _PITCH_PX * (_LINES - 1)
    size = int(2.0 * (half + _PITCH_PX) * 1.4)
    y, x = np.mgrid[:size, :size] - 0.5 * (size - 1)
    along = x * np.cos(_ANGLE_RAD) + y * np.sin(_ANGLE_RAD), y * np.cos(_ANGLE_RAD) - x * np.sin(_ANGLE_RAD)
    bright = np.ones_like(x)
    for across, length in (along, along[::-1]):
        off = across - _PITCH_PX * np.clip(np.round(across / _PITCH_PX), -(_LINES // 2), _LINES // 2)
        bright *= 1.0 - np.exp(-0.5 * (off / _SIGMA_PX) ** 2) * (np.abs(length) < half + 0.5 * _PITCH_PX)
    grey = 40.0 + 170.0 * bright + np.random.default_rng(1).normal(0.0, 1.0, x.shape)
    detect_grid(
        np.clip(grey, 0, 255).astype(np.uint8), GridTarget(pitch_mm=1.0, lines=(_LINES, _LINES), line_width_mm=0.05)
    )
