"""A worker that helps with another one's step."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from core.cameras.stereo import StereoPair
from core.errors import Cancelled
from core.field.points.images import MeasureImage
from core.field.points.tile import TileFits
from server.compute.tiles import files
from server.formats.calibrations.recognise import load_calibration
from server.formats.images import read_image
from server.worker.process import TaskChannel, current_task
from server.worker.tile_task import TileTask


class _Wanted:
    """A cancel token: set too once nobody wants the tiles."""

    def __init__(self, task: TileTask, channel: TaskChannel) -> None:
        self._task, self._channel = task, channel

    @property
    def cancelled(self) -> bool:
        return self._channel.cancelled or not self._task.wanted


def fit_tiles(task: TileTask) -> int:
    """Fit tiles for as long as there are any that nobody has taken; returns their number.

    Raises
    ------
    Cancelled
        The service asked for it.
    StereorigError
        Images or calibration cannot be read; the tiles are fitted by whoever wanted them.
    """
    channel, done = current_task(), 0
    token = _Wanted(task, channel)
    fits = None
    for k in range(task.tiles):
        channel.check()
        if not files.claim(task.folder, k):
            continue
        try:
            if fits is None:
                pixels = [_pixels(path, path.stat().st_mtime_ns) for path in task.images]
                calibration = task.calibration, task.calibration.stat().st_mtime_ns
                fits = TileFits(_pair(*calibration), pixels, task.setting)
            points, visible = files.tile_in(task.folder, k)
            files.put_fits(task.folder, k, fits.fit(points, visible, token))
        except (OSError, Cancelled):
            if task.wanted:
                raise
            break
        done += 1
    return done


@lru_cache(maxsize=4)
def _pixels(path: Path, _changed_ns: int) -> NDArray[Any]:
    """Return an image's grey levels; the reference's are the same in each step."""
    return MeasureImage(read_image(path), str(path)).pixels


@lru_cache(maxsize=1)
def _pair(path: Path, _changed_ns: int) -> StereoPair:
    return load_calibration(path).pair
