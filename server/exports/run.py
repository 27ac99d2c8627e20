"""An export from the request to the files, one step in memory at a time."""

from __future__ import annotations

import itertools
import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from stereorig.core.errors import InputError
from stereorig.server.exports.film import check_fps, frames, write_gif, write_mp4
from stereorig.server.exports.matlab import write_mat
from stereorig.server.exports.pictures import image_of, picture_of, write_figure
from stereorig.server.exports.request import ExportRequest
from stereorig.server.exports.stacked import scalars_of, write_stacked
from stereorig.server.exports.table import write_table
from stereorig.server.exports.vtu import NEEDS, write_pvd, write_vtu
from stereorig.server.formats.files import written_temporary
from stereorig.server.formats.images import read_mask
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.formats.results.folder import home_of, number_of
from stereorig.server.formats.results.netcdf import add_scalars
from stereorig.server.results.channels import has_more, rising
from stereorig.server.results.provenance import provenance
from stereorig.server.results.steps import (
    ExportSource,
    StepResult,
    chosen,
    columns_of,
    each,
    read_step,
    require_known,
    step_name,
    variables_of,
    with_coverage,
)
from stereorig.server.results.uncertainty import in_file
from stereorig.server.worker.process import current_task

_PACKED = (".nc", ".png", ".gif", ".mp4", ".mat", ".h5")


def export(source: ExportSource, request: ExportRequest, out: Path) -> Iterator[Path]:
    """Write an export's files into a folder, one after the other; yields each as it is finished.

    Raises
    ------
    InputError
        ``figure_style_invalid``, ``steps_mixed``, ``export_too_large``, ``mask_unusable``.
    NotFoundError
        ``no_results``, ``step_missing``, ``field_missing``, ``image_missing``.
    FileFormatError
        A result file that cannot be read.
    StorageError
        ``storage_full``, ``storage_failed``.
    """
    source = replace(source, coverage=request.coverage)
    files = chosen(source, request.steps)
    if request.format in ("gif", "mp4"):
        check_fps(request.fps)
    if request.format == "nc":
        yield from _as_stored(source, files, request, out)
    elif request.format == "csv":
        for step in each(source, request.steps, request.variables):
            path = _path(out, source, step, "csv")
            write_table(path, step, source, asked=request.variables is not None)
            yield path
    elif request.format == "vtu":
        yield from _as_vtu(source, files, request, out)
    elif request.format == "mat":
        path = out / f"{source.name}.mat"
        write_mat(path, source, request.steps, request.variables)
        yield path
    elif request.format == "h5":
        path = out / f"{source.name}.h5"
        write_stacked(path, source, request.steps, request.variables)
        yield path
    else:
        yield from _drawn(source, files, request, out)


def export_packed(source: ExportSource, request: ExportRequest, folder: Path) -> Path:
    """Write an export into a folder as one file: its only one, or a ZIP of several; return its path."""
    made = _watched(export(source, request, folder), source, request)
    first = next(made)
    second = next(made, None)
    if second is None:
        return first
    packed = folder / f"{source.name}_{request.format}.zip"
    with zipfile.ZipFile(packed, "w", compression=zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        for path in itertools.chain((first, second), made):
            packing = zipfile.ZIP_STORED if path.suffix in _PACKED else None
            archive.write(path, path.name, compress_type=packing)
            path.unlink()
    return packed


def _watched(made: Iterator[Path], source: ExportSource, request: ExportRequest) -> Iterator[Path]:
    """Report each file of an export to the task that makes it, and end with it; a film reports its frames itself."""
    task, film = current_task(), request.format in ("gif", "mp4")
    expected = len(chosen(source, request.steps)) * (
        len(request.variables or [""]) if request.format in ("png", "svg") else 1
    )
    for k, path in enumerate(made, 1):
        task.check()
        if not film:
            task.progress("writing", min(k, expected), expected)
        yield path


def _path(out: Path, source: ExportSource, step: StepResult, suffix: str) -> Path:
    return out / f"{step_name(source, step)}.{suffix}"


def _as_stored(source: ExportSource, files: Sequence[Path], request: ExportRequest, out: Path) -> Iterator[Path]:
    if request.variables is not None:
        raise InputError(
            "NetCDF files are given as they are stored, with all variables.",
            code="option_conflict",
            remedy="Leave the variables out, or choose h5.",
        )
    if request.coverage.factor != 1.0:
        raise InputError(
            "NetCDF files are given as they are stored, with standard uncertainties.",
            code="option_conflict",
            remedy="Leave k and coverage out, or choose h5.",
        )
    for path in files:
        step = read_step(path, [], home=source.home)
        copy = _path(out, source, step, "nc")
        with written_temporary(copy) as temporary:
            temporary.write_bytes(checked_bytes(path))
            if has_more(path, source.home or home_of(path)):
                add_scalars(temporary, scalars_of(step.recorded))
        yield copy


def _as_vtu(source: ExportSource, files: Sequence[Path], request: ExportRequest, out: Path) -> Iterator[Path]:
    mask = None if source.mask is None else read_mask(source.mask)
    there = {path: variables_of(path, derived=True) for path in source.files}
    moves = any("u_mm" in names for names in there.values())
    asked = None if request.variables is None else [in_file(name, source.coverage) for name in request.variables]
    require_known(files, asked)
    heads = [read_step(path, [], home=source.home) for path in files]
    times = rising(head.recorded.time_s for head in heads) or [float(head.n) for head in heads]
    written = []
    for path, time in zip(files, times, strict=True):
        names = asked
        if names is not None:
            names = [name for name in (*names, *NEEDS) if name in there[path]]
        step = with_coverage(read_step(path, names, home=source.home), source)
        target = _path(out, source, step, "vtu")
        write_vtu(target, step, source, mask=mask, at_rest=moves and "u_mm" not in there[path], time=time)
        written.append((time, target.name))
        yield target
    series = out / f"{source.name}.pvd"
    write_pvd(series, written)
    yield series


def _drawn(source: ExportSource, files: Sequence[Path], request: ExportRequest, out: Path) -> Iterator[Path]:
    image = image_of(source, request.over_image)
    names = request.variables
    if names is None:
        moves = any("w_mm" in variables_of(path) for path in files)
        names = ["w_mm" if moves else "z_mm"]
    for name in names:
        require_known(files, [in_file(name, source.coverage)])
        if request.format in ("gif", "mp4"):
            path = out / f"{source.name}_{name}.{request.format}"
            drawn = frames(source, request.steps, name, request.style, image)
            if request.format == "gif":
                first = read_step(files[0], [], home=source.home)
                comment = json.dumps(provenance(first, source), sort_keys=True)
                write_gif(path, drawn, request.fps, comment, request.style, over_image=request.over_image)
            else:
                write_mp4(path, drawn, request.fps)
            yield path
            continue
        for step in each(source, request.steps, [name]):
            if name in columns_of(step) or step.n == number_of(files[-1]):
                path = out / f"{step_name(source, step)}_{name}.{request.format}"
                form: Literal["png", "svg"] = "svg" if request.format == "svg" else "png"
                write_figure(path, picture_of(step, name, source, image), request.style, form)
                yield path
