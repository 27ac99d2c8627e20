"""Those who may fit tiles of a step: whoever takes them from a folder, once the service has called workers."""

from __future__ import annotations

import logging
import secrets
import shutil
import time
import weakref
from collections.abc import Callable
from pathlib import Path

from core.field.points.crew import Shared, ToFit
from core.field.points.fitter import Fitter, PointFits
from core.field.points.tile import TileSetting, images_of
from core.matching.image import ImageData
from server.compute.tiles import files
from server.formats.results.folder import TILES
from server.worker.tile_task import TileTask

_log = logging.getLogger("stereorig.tiles")

Call = Callable[[TileTask], bool]
FITTED = "%d of %d tiles were fitted by other workers; the rest took %.3f s of processor time here"


class FolderCrew:
    """The crew of an analysis.

    Parameters
    ----------
    folder
        Of the analysis.
    calibration
        Path of the calibration.
    call
        Tells the service of tiles; returns False where nobody hears it now.
    """

    def __init__(self, folder: Path, calibration: Path, call: Call) -> None:
        self._folder, self._calibration, self._call = folder, calibration, call
        self._files: weakref.WeakKeyDictionary[ImageData, Path] = weakref.WeakKeyDictionary()

    def know(self, image: ImageData, path: Path) -> None:
        """Learn which file an image was read from."""
        self._files[image] = path

    def share(self, fitter: Fitter, tiles: list[ToFit]) -> Shared | None:
        """Put tiles into a folder and call for workers; None where a tile's fits need more than it would have."""
        setting = TileSetting.of(fitter)
        images = tuple(path for path in map(self._files.get, images_of(fitter)) if path is not None)
        if setting is None or len(images) < len(images_of(fitter)):
            return None
        began = time.process_time()
        folder = self._folder / f"{TILES}{secrets.token_hex(6)}"
        try:
            folder.mkdir(parents=True)
            for k, points in enumerate(tiles):
                files.put_tile(folder, k, points, fitter.visible(points.xy_px))
        except OSError as error:
            _log.warning("tiles could not be shared out (%s); they are fitted here", error)
            shutil.rmtree(folder, ignore_errors=True)
            return None
        task = TileTask(folder=folder, tiles=len(tiles), calibration=self._calibration, images=images, setting=setting)
        return _SharedFolder(task, self._call, began)


class _SharedFolder:
    """Tiles in a folder."""

    def __init__(self, task: TileTask, call: Call, began: float) -> None:
        self._task, self._call, self._began = task, call, began
        self._called = call(task)
        self._others = 0

    def claim(self, k: int) -> bool:
        """Take a tile."""
        if not self._called:  # between two tasks nobody heard it
            self._called = self._call(self._task)
        return files.claim(self._task.folder, k)

    def fitted(self, k: int) -> PointFits | None:
        """Return what another one made of a tile."""
        found = files.fits_in(self._task.folder, k)
        self._others += found is not None
        return found

    def close(self) -> None:
        """Want nothing any more."""
        shutil.rmtree(self._task.folder, ignore_errors=True)
        spent = time.process_time() - self._began
        _log.info(FITTED, self._others, self._task.tiles, spent)
