"""Result files in another frame."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from stereorig.core.errors import MeasurementError
from stereorig.server.formats.files import recorded_sha256, write_bytes
from stereorig.server.formats.results.folder import home_of
from stereorig.server.formats.results.reading import read_head
from stereorig.server.results.gauges.fields import FieldWriter
from stereorig.server.results.gauges.frames import frame_asked, frame_of_test
from stereorig.server.results.gauges.readings import read_gauges
from stereorig.server.results.gauges.request import Alignment, GaugeRequest
from stereorig.server.store.durable import known_json


def write_framed(
    files: Sequence[Path], asked: Alignment, folder: Path, *, strain: bool = True, laid_through: Path | None = None
) -> list[Path]:
    """Write result files in a frame that the first of them defines, or another file; return their paths.

    Raises
    ------
    StereorigError
        As :func:`read_gauges`.
    """
    request = GaugeRequest(align=asked)
    writer = FieldWriter(folder, files[0].parent, request, strain=strain)
    readings = read_gauges(files, request, writer, laid_through=laid_through)
    problem = next((s.problem for s in readings.steps if s.problem is not None), None)
    if problem is not None:
        raise MeasurementError(problem.detail, code=problem.code, remedy=problem.remedy)
    return writer.written


def put_into_frame(files: Sequence[Path], asked: Alignment) -> str:
    """Replace result files of one measurement by the same in a frame; return the frame that they then state.

    Raises
    ------
    StereorigError
        As :func:`write_framed`; the files are then as they were.
    """
    with tempfile.TemporaryDirectory(dir=files[0].parent, prefix=".frame") as folder:
        for source, made in zip(files, write_framed(files, asked, Path(folder)), strict=True):
            write_bytes(source, made.read_bytes(), checksum=recorded_sha256(source) is not None)
    return read_head(files[-1]).frame


def asked_at(text: str | None, result: Path) -> Alignment | None:
    """Return the frame that a command names for a result file and its neighbours, None for the system frame.

    Raises
    ------
    InputError
        ``frame_invalid``.
    """
    kept = known_json(home_of(result.absolute()).parent.parent / "test.json").get("frame")
    return frame_asked(text, frame_of_test(kept if isinstance(kept, dict) else None))


def in_frame(files: Sequence[Path], asked: Alignment | None, out: Path, *, strain: bool = True) -> list[Path]:
    """Return result files in a frame, written into a folder; they themselves for the system frame.

    The frame is defined by the reference's result, if its file is among the measurement's; for dense fields by the
    ordinary result of the reference. Without ``strain`` strain is not computed again, for callers that read none.

    Raises
    ------
    StereorigError
        As :func:`write_framed`.
    """
    if asked is None:
        return list(files)
    n = read_head(files[-1]).reference_step
    reference = None if n is None else home_of(files[-1]) / f"step_{n:04d}.nc"
    if reference is None or reference in files or not reference.is_file():
        reference = None
    return write_framed(files, asked, out, strain=strain, laid_through=reference)
