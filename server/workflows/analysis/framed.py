"""Results in another frame than the one that they are stored in: made when they are asked for, and kept for a while."""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from server.formats.files import known_sha256
from server.results.gauges.framed import in_frame, write_framed
from server.results.gauges.frames import frame_asked, frame_of_test, part_of
from server.results.gauges.request import Alignment

if TYPE_CHECKING:
    from server.workflows.service import Service

_KEPT_BYTES = 1 << 30


class FramedResults:
    """Result files in other frames; those used least recently go first.

    Parameters
    ----------
    folder
        Where they lie; made with the first one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, Path] = OrderedDict()

    def file(self, source: Path, asked: Alignment, laid_through: Path | None, *, strain: bool = True) -> Path:
        """Return a result file in a frame that is laid through it, or through another.

        Raises
        ------
        StereorigError
            As :func:`read_gauges`.
        """
        files = [source] if laid_through is None else [laid_through, source]
        text = "\n".join([f"{strain}", asked.model_dump_json(), *(known_sha256(path) for path in files)])
        key = hashlib.sha256(text.encode()).hexdigest()
        with self._lock:  # one at a time: several requests ask for one step at once
            known = self._kept.get(key)
            if known is not None and known.is_file():
                self._kept.move_to_end(key)
                return known
            out = self._folder / key
            made = write_framed([source], asked, out, strain=strain, laid_through=laid_through)[0]
            self._kept[key] = made
            self._forget()
            return made

    def _forget(self) -> None:
        sizes = {key: path.stat().st_size if path.is_file() else 0 for key, path in self._kept.items()}
        while len(self._kept) > 1 and sum(sizes[key] for key in self._kept) > _KEPT_BYTES:
            _, path = self._kept.popitem(last=False)
            shutil.rmtree(path.parent, ignore_errors=True)


def asked_of(service: Service, test_id: str, frame: str | None) -> Alignment | None:
    """Return the frame that a request names, None for the system frame; see :func:`frame_asked`."""
    if frame in (None, "system"):
        return None
    kept = service.tests.read(test_id).plain().get("frame")
    return frame_asked(frame, frame_of_test(kept if isinstance(kept, dict) else None))


def result_in(
    service: Service, test_id: str, analysis_id: str, n: int, frame: str | None, name: str | None = None
) -> Path:
    """Return the result file of a step in a frame; the stored one for the system frame.

    Parameters
    ----------
    name
        Variable that will be read of it: one that is the same in every frame is read where it is stored, and strain is
        made anew for its own components alone.
    """
    return file_in(
        service, test_id, analysis_id, service.tests.analyses.result_file(test_id, analysis_id, n), frame, name
    )


def file_in(
    service: Service, test_id: str, analysis_id: str, source: Path, frame: str | None, name: str | None = None
) -> Path:
    """Return one of an analysis' result files, dense or not, in a frame; see :func:`result_in`."""
    asked = asked_of(service, test_id, frame)
    part = "strain" if name is None else part_of(name)
    if asked is None or part == "none":
        return source
    reference = _reference(service, test_id, analysis_id)
    return service.framed.file(source, asked, None if reference == source else reference, strain=part == "strain")


def results_in_frame(
    service: Service,
    test_id: str,
    files: Sequence[Path],
    frame: str | None,
    folder: Path,
    *,
    variables: Sequence[str] | None = None,
) -> list[Path]:
    """Return result files in a frame, written into a folder; the stored ones for the system frame.

    Parameters
    ----------
    variables
        Those that are read of them: strain is not made anew for others. None: all.
    """
    asked = asked_of(service, test_id, frame)
    if asked is None:
        return list(files)
    name = variable_of_frame(variables)
    return in_frame(files, asked, folder, strain=name is None or part_of(name) == "strain")


def variable_of_frame(variables: Sequence[str] | None) -> str | None:
    """Return the one of several variables for which most has to be made anew in another frame; None: all of them."""
    order = ("none", "field", "strain")
    return None if variables is None else max(variables, key=lambda name: order.index(part_of(name)))


def _reference(service: Service, test_id: str, analysis_id: str) -> Path | None:
    """Return the reference's result, through which a frame is laid; None where it is not there."""
    reference = service.tests.analyses.read(test_id, analysis_id).steps[0]
    if reference not in service.tests.analyses.finished_steps(test_id, analysis_id):
        return None
    return service.tests.analyses.result_file(test_id, analysis_id, reference)
