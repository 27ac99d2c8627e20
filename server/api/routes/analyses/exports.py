"""Exports: an analysis in the forms that other programs read."""

from __future__ import annotations

import asyncio
import functools
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.concurrency import run_in_threadpool

from stereorig.core.errors import Cancelled
from stereorig.server.api.models import Accepted
from stereorig.server.api.protocol.dependencies import AnalysisId, CoverageDep, FrameText, ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.errors import NotFoundError
from stereorig.server.exports.request import (
    MEDIA_CONTENT,
    MEDIA_TYPES,
    ExportFormat,
    ExportRequest,
    media_type_of,
    steps_in,
)
from stereorig.server.formats.figures.options import COLOURS, MAX_LEVELS, WIDTHS_PX, FigureStyle
from stereorig.server.formats.results.folder import dense_result, home_of
from stereorig.server.results.channels import has_more
from stereorig.server.results.naming import stored_name
from stereorig.server.worker.executor import TaskFuture
from stereorig.server.workflows.analysis import start as analysis_start
from stereorig.server.workflows.analysis.framed import results_in_frame
from stereorig.server.workflows.export_job import start_export
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
_PAIR = r"^-?[0-9.]+([eE][-+]?[0-9]+)?,-?[0-9.]+([eE][-+]?[0-9]+)?$"
_CHUNK_BYTES = 1 << 20
_POLL_S = 0.05


@dataclass(frozen=True)
class _Drawn:
    """Style of figures and films."""

    style: FigureStyle
    over_image: bool
    fps: float


def _drawn(
    limits: Annotated[
        str | None,
        Query(
            max_length=60,
            pattern=_PAIR,
            description="Ends of the colour scale, in the variable's unit.",
            examples=["-0.05,0.05"],
        ),
    ] = None,
    percentiles: Annotated[
        str, Query(max_length=40, pattern=_PAIR, description="Else the percentiles of the values at its ends.")
    ] = "1,99",
    colours: Annotated[str, Query(pattern=f"^({'|'.join(COLOURS)})$", description="Colour map.")] = "viridis",
    levels: Annotated[int, Query(ge=0, le=MAX_LEVELS, description="Bands of one colour; 0: smooth.")] = 0,
    reverse: Annotated[bool, Query(description="The colour map from its other end.")] = False,
    opacity: Annotated[float, Query(gt=0.0, le=1.0, description="Opacity of the map over the image.")] = 0.75,
    width_px: Annotated[int, Query(ge=WIDTHS_PX[0], le=WIDTHS_PX[1], description="Width of the picture.")] = 900,
    over_image: Annotated[bool, Query(description="Draw over camera 1's reference image.")] = False,
    fps: Annotated[float, Query(ge=0.1, le=60.0, description="Steps a second in a film.")] = 2.0,
) -> _Drawn:
    style = FigureStyle(
        limits=None if limits is None else _pair(limits),
        percentiles=_pair(percentiles),
        colours=colours,
        width_px=width_px,
        opacity=opacity,
        levels=levels,
        reverse=reverse,
    )
    return _Drawn(style, over_image, fps)


def _pair(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:  # several points in a number
        return float("nan"), float("nan")
    return low, high


@dataclass(frozen=True)
class _Asked:
    """An export that was asked for."""

    request: ExportRequest
    steps: list[int] | None
    frame: str | None
    dense: bool


def _asked(
    drawn: Annotated[_Drawn, Depends(_drawn)],
    coverage: CoverageDep,
    format: Annotated[  # noqa: A002
        ExportFormat,
        Query(
            description="nc: NetCDF-4 as stored; csv; vtu: ParaView, with a PVD time series; mat: MATLAB; h5: HDF5, "
            "all steps stacked; png, svg: figures; gif, mp4: films over the steps."
        ),
    ] = "nc",
    step: Annotated[int | None, Query(ge=0, le=9999, description="One step; all finished ones if left out.")] = None,
    steps: Annotated[
        str | None,
        Query(
            max_length=500,
            pattern=r"^[0-9]{1,4}(-[0-9]{1,4})?(,[0-9]{1,4}(-[0-9]{1,4})?)*$",
            description="Several steps.",
            examples=["0,3-7"],
        ),
    ] = None,
    variables: Annotated[
        str | None,
        Query(
            max_length=1000,
            pattern=r"^[a-z][a-z0-9_]{0,63}(,[a-z][a-z0-9_]{0,63})*$",
            examples=["w_mm,exx"],
            description="Variables of the result files; all if left out, of figures and films w_mm or z_mm.",
        ),
    ] = None,
    frame: FrameText = None,
    dense: Annotated[bool, Query(description="The dense fields of an analysis with `dense_step_px`.")] = False,
) -> _Asked:
    wanted = [step] if step is not None else None if steps is None else steps_in(steps)
    names = None if variables is None else variables.split(",")
    request = ExportRequest(format, None, names, drawn.style, drawn.over_image, drawn.fps, coverage)
    return _Asked(request, wanted, frame, dense)


AskedDep = Annotated[_Asked, Depends(_asked)]


@router.get(
    "/export",
    summary="Results in the forms that other programs read",
    response_class=FileResponse,
    responses=errors(404, 409, 422, 503, 507)
    | {200: {"description": "The file; several are one ZIP archive.", "content": MEDIA_CONTENT}},
)
async def export(
    request: Request, service: ServiceDep, test_id: TestId, analysis_id: AnalysisId, asked: AskedDep
) -> Response:
    """Answer with the file once it is made; several files are one ZIP archive.

    Every form states units, frame, settings, calibration and version, and the terms that its uncertainties include;
    docs/reference/exports.md describes each. With k or coverage it also has `expanded_NAME` for every `sigma_NAME`. The
    header X-Stale lists inputs that are gone or were replaced since the analysis. A client that leaves ends its export.
    """
    wanted, frame = asked.request, asked.frame
    files, headers = await run_in_threadpool(_prepared, service, test_id, analysis_id, asked.steps, asked.dense)
    as_stored = wanted.variables is None and wanted.coverage.factor == 1.0 and frame in (None, "system")
    home = home_of(files[0])
    as_stored &= wanted.format == "nc" and len(files) == 1
    if as_stored and not await run_in_threadpool(has_more, files[0], home):
        name = await run_in_threadpool(stored_name, files[0], home)
        return FileResponse(files[0], media_type=MEDIA_TYPES["nc"], headers=headers, filename=name)
    folder = await run_in_threadpool(service.exports.new_folder)
    try:
        framed = functools.partial(results_in_frame, variables=wanted.drawn_variables)
        files = await run_in_threadpool(framed, service, test_id, files, frame, folder / "frame")
        made = Path(await _made(request, service, home, files, wanted, folder))
        file = made.open("rb")
    finally:
        # the opened file stays until it is sent, even if the client leaves or the service ends
        await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
    headers |= {"Content-Disposition": f'attachment; filename="{made.name}"', "Content-Length": str(file.seek(0, 2))}
    return StreamingResponse(_chunks(file), media_type=media_type_of(made), headers=headers)


@router.post("/exports", summary="Begin an export as a job", status_code=202, responses=errors(404, 409, 422, 503, 507))
def begin_export(service: ServiceDep, test_id: TestId, analysis_id: AnalysisId, asked: AskedDep) -> Accepted:
    """Begin the export of `GET .../export` with the same parameters, as a job with progress that can be cancelled.

    Meant for films and for many steps. `GET /jobs/{job_id}/file` answers with the file once the job has succeeded; it
    is kept until eight later exports are, or the service ends.
    """
    files, _ = _prepared(service, test_id, analysis_id, asked.steps, asked.dense)
    service.require_room()
    job = start_export(service, test_id, analysis_id, files, asked.request, asked.frame)
    return Accepted.model_validate({"job": job.document().plain()})


def _prepared(
    service: Service, test_id: str, analysis_id: str, wanted: list[int] | None, dense: bool
) -> tuple[list[Path], dict[str, str]]:
    document = service.tests.analyses.read(test_id, analysis_id)
    there = service.tests.analyses.finished_steps(test_id, analysis_id)
    files = [service.tests.analyses.result_file(test_id, analysis_id, n) for n in (there if wanted is None else wanted)]
    if not files:
        raise NotFoundError(
            f"Analysis {analysis_id} has no finished step.",
            code="no_results",
            remedy="Wait for its job, or measure again.",
        )
    if dense:
        files = [file for file in map(dense_result, files) if wanted is not None or file.is_file()]
        if not files or not all(file.is_file() for file in files):
            raise NotFoundError(
                f"Analysis {analysis_id} has no dense field of these steps.",
                code="dense_missing",
                remedy="Measure with dense_step_px; the summary's `dense` has the reason of a step without one.",
            )
    stale = analysis_start.stale_reasons(service, test_id, document)
    return files, {"X-Stale": "; ".join(stale)} if stale else {}


async def _made(
    request: Request, service: Service, home: Path, files: list[Path], export_request: ExportRequest, folder: Path
) -> str:
    service.require_room()
    return str(await finished(request, service.exports.submit(home, files, export_request, folder)))


async def finished(request: Request, future: TaskFuture) -> Any:
    """Wait for a task without delaying other clients; return its result. A client that goes away ends it."""
    try:
        while not future.done():
            await asyncio.sleep(_POLL_S)
            if await request.is_disconnected():
                raise Cancelled("The client went away.")
    except BaseException:
        future.request_stop()
        raise
    return future.result()


def _chunks(file: IO[bytes]) -> Iterator[bytes]:
    with file:
        file.seek(0)
        while chunk := file.read(_CHUNK_BYTES):
            yield chunk
