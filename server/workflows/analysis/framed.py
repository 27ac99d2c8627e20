"""Results in another frame than the one that they are stored in: made when they are asked for, and kept for a while."""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stereorig.server.formats.manifest import known_sha256
from stereorig.server.formats.results.variables import described
from stereorig.server.results.gauges.framed import in_frame, write_framed
from stereorig.server.results.gauges.frames import frame_asked, frame_of_test
from stereorig.server.results.gauges.request import Alignment

if TYPE_CHECKING:
    from stereorig.server.workflows.service import Service

_KEPT_BYTES = 1 << 30


class FramedResults:
    """Result files in other frames; the least recently used are deleted first.

    Parameters
    ----------
    folder
        Folder of the files; made with the first one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, Path] = OrderedDict()

    def file(self, source: Path, asked: Alignment, laid_through: Path | None, *, strain: bool = True) -> Path:
        """Return a result file in a frame that it defines, or another file.

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
        Variable that will be read from it: if it is the same in every frame, the stored file is returned; strain is
        computed again only if a strain component is read.
    """
    return file_in(
        service, test_id, analysis_id, service.tests.analyses.result_file(test_id, analysis_id, n), frame, name
    )


def file_in(
    service: Service, test_id: str, analysis_id: str, source: Path, frame: str | None, name: str | None = None
) -> Path:
    """Return one of an analysis' result files, dense or not, in a frame; see :func:`result_in`."""
    asked = asked_of(service, test_id, frame)
    part = "strain" if name is None else described(name).part
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
        Variables that will be read: strain is computed again only if one of them is a strain. None: all.
    """
    asked = asked_of(service, test_id, frame)
    if asked is None:
        return list(files)
    name = variable_of_frame(variables)
    return in_frame(files, asked, folder, strain=name is None or described(name).part == "strain")


def variable_of_frame(variables: Sequence[str] | None) -> str | None:
    """Return the variable that needs the most computation in another frame; None, for all variables, if None."""
    order = ("none", "field", "strain")
    return None if variables is None else max(variables, key=lambda name: order.index(described(name).part))


def _reference(service: Service, test_id: str, analysis_id: str) -> Path | None:
    """Return the reference's result, which defines the frame; None if it is not measured."""
    reference = service.tests.analyses.read(test_id, analysis_id).steps[0]
    if reference not in service.tests.analyses.finished_steps(test_id, analysis_id):
        return None
    return service.tests.analyses.result_file(test_id, analysis_id, reference)
