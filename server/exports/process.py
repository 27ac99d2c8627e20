"""Exports in a process of their own, started with the first and ended some time after the last.

Drawing and compressing hold Python's interpreter for tenths of a second; in the service's process they would delay its
answers, in the measuring worker an analysis.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereorig.server.base.errors import QueueFullError
from stereorig.server.exports.request import ExportRequest
from stereorig.server.worker.executor import TaskFuture
from stereorig.server.worker.resting import RestingWorker

FOLDER = ".exports"
_MAX_WAITING = 4
_KEPT_FILES = 8  # of exports that were jobs


def export_task(folder: str, files: list[str], request: ExportRequest, out: str) -> str:
    """Export an analysis' result files as one file; return its path. Runs in the export process."""
    # matplotlib and SciPy are loaded here alone
    from stereorig.server.exports.run import export_packed
    from stereorig.server.exports.source import source_of

    made = export_packed(source_of(Path(folder), [Path(f) for f in files]), request, Path(out))
    return str(made)


class ExportProcess:
    """Runs exports one after the other, in a process that ends when it was idle for a while.

    Parameters
    ----------
    data
        The data folder: unfinished files are under it, on the disk whose free space is monitored.
    """

    def __init__(self, data: Path) -> None:
        self._folder = data / FOLDER
        self._lock = threading.Lock()
        self._process = RestingWorker()
        self._kept: dict[str, Path] = {}  # by job, the oldest first

    def clear(self) -> None:
        """Remove files that a kill left."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def new_folder(self) -> Path:
        """Make a folder for one export; the caller removes it."""
        self._folder.mkdir(exist_ok=True)
        return Path(tempfile.mkdtemp(dir=self._folder))

    def keep(self, job_id: str, file: Path) -> Path:
        """Keep a job's file until eight later ones are kept, or the service ends; return its new path."""
        home = self._folder / "kept" / job_id
        home.mkdir(parents=True, exist_ok=True)
        kept = file.rename(home / file.name)
        with self._lock:
            self._kept[job_id] = kept
            gone = [self._kept.pop(old) for old in list(self._kept)[:-_KEPT_FILES]]
        for path in gone:
            shutil.rmtree(path.parent, ignore_errors=True)
        return kept

    def kept(self, job_id: str) -> Path | None:
        """Return the file that is kept for a job; None if there is none, or none any more."""
        with self._lock:
            return self._kept.get(job_id)

    def check_room(self) -> None:
        """Refuse an export that would be refused by :meth:`run`."""
        waiting = self._process.unfinished
        if self._process.closed or waiting >= _MAX_WAITING:
            raise QueueFullError(f"{waiting} exports are being made.", code="exports_waiting")

    def submit(self, folder: Path, files: list[Path], request: ExportRequest, out: Path) -> TaskFuture:
        """Begin an export, see :func:`export_task`; raises as :meth:`run`."""
        return self.run(export_task, str(folder), [str(f) for f in files], request, str(out))

    def run(self, task: Callable[..., Any], *args: Any) -> TaskFuture:
        """Begin a task in the export process; everything must pickle.

        Raises
        ------
        QueueFullError
            ``exports_waiting`` if four are on their way.
        """
        with self._lock:
            self.check_room()
            return self._process.submit(task, *args)

    def close(self) -> None:
        """End the process; exports on their way fail."""
        self._process.close()
        shutil.rmtree(self._folder, ignore_errors=True)
