"""The task that fits tiles of a step which another worker measures: plain values in, a count out."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from core.field.points.tile import TileSetting


@dataclass(frozen=True, kw_only=True)
class TileTask:
    """Tiles that any worker may take who sees the analysis' folder.

    Parameters
    ----------
    folder
        Of the tiles; gone once nobody wants them any more.
    tiles
        How many there are.
    calibration
        Path of the test's calibration.
    images
        Paths of camera 1's and camera 2's reference image and, of a motion, current image.
    setting
        What the tiles have in common.
    """

    folder: Path
    tiles: int
    calibration: Path
    images: tuple[Path, ...]
    setting: TileSetting

    @property
    def wanted(self) -> bool:
        """True while somebody waits for tiles."""
        return self.folder.is_dir()


def fit_tiles(task: TileTask) -> int:
    """Fit tiles for as long as there are any that nobody has taken; returns their number."""
    importlib.import_module("server.compute.measurement").await_kernels()
    fitted: int = importlib.import_module("server.compute.tiles.helper").fit_tiles(task)
    return fitted
