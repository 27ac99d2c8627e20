"""Live measurement: begin and end, newest values and their streams, channels read at the same time."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator
from dataclasses import asdict
from typing import Annotated, Literal, get_args

import anyio
import numpy as np
from fastapi import APIRouter, Depends, Query, Request, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent
from numpy.typing import NDArray

from stereorig.core.errors import StateError, StereorigError
from stereorig.server.api.models.live import (
    AlignReply,
    AlignRequest,
    LiveField,
    LiveHistory,
    LiveReadings,
    LiveReadingsReply,
    LiveReply,
)
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, TestId, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.service.system import EventStream
from stereorig.server.base.models import Ids
from stereorig.server.workflows.live.request import LiveSettings
from stereorig.server.workflows.live.run import LiveRun
from stereorig.server.workflows.live.runs import LiveRuns
from stereorig.server.workflows.service import Service

_MAX_FRAMES = 6000
_MAX_FIELDS_HZ = 20.0
Component = Literal["u_mm", "v_mm", "w_mm"]
_COMPONENTS: tuple[Component, ...] = get_args(Component)
_REFUSED = 1008


def get_runs(request: Request) -> LiveRuns:
    """Return the live measurements of the app's service."""
    runs: LiveRuns = request.app.state.live_runs
    return runs


RunsDep = Annotated[LiveRuns, Depends(get_runs)]


def known_run(runs: RunsDep, test_id: TestId) -> LiveRun:
    """Return the test's live measurement, or 404 before a stream begins."""
    return runs.of(test_id)


RunDep = Annotated[LiveRun, Depends(known_run)]


def known_field(run: RunDep) -> None:
    """Refuse a live measurement without a field, before a stream begins.

    Raises
    ------
    StateError
        ``no_results``.
    """
    if not run.whole_field:
        raise StateError("This live measurement has no field.", code="no_results", remedy="Begin with field = true.")


router = APIRouter(prefix="/tests/{test_id}", tags=["live"])


def _shown(request: Request, run: LiveRun) -> LiveReply:
    return LiveReply.model_validate(
        {
            "test_id": run.test_id,
            "state": run.state,
            "since_utc": run.since_utc,
            "settings": run.settings,
            "problem": None if run.problem is None else run.problem.plain(),
            "reference_points": run.begun.get("points"),
            "values": run.newest(),
            "account": run.account.document(),
            "channels": _channels(run),
            "tcp_port": request.app.state.lines.port,
        }
    )


def _channels(run: LiveRun) -> dict[str, dict[str, object]]:
    lines, readings = run.lines.document(), run.series.channels()
    return {name: {**lines.get(name, {}), **readings.get(name, {})} for name in {**lines, **readings}}


@router.post("/live", summary="Measure a test live", status_code=201, responses=errors(404, 409, 422, 503))
def begin_live(
    request: Request, service: ServiceDep, runs: RunsDep, test_id: TestId, body: LiveSettings, key: KeyHeader = None
) -> LiveReply:
    """Measure each frame pair as it comes against a stored step, until it is ended; frames are not stored.

    The newest pair counts: pairs that come while one is measured are skipped, and counted. Captures, calibrations and
    analyses continue. There is one live measurement at a time; it ends with the service.
    """
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/live", key, body)

    def make() -> Ids:
        return {"test_id": runs.begin(test_id, body).test_id}

    service.once(sent.scope, key, sent.body_sha256, make)
    return _shown(request, runs.of(test_id))


@router.get("/live", summary="The live measurement and its newest values", responses=errors(404))
def get_live(request: Request, run: RunDep) -> LiveReply:
    """Return state, newest values, the account of the frames, and channels."""
    return _shown(request, run)


@router.post("/live:stop", summary="End the live measurement", responses=errors(404))
def stop_live(request: Request, runs: RunsDep, test_id: TestId) -> LiveReply:
    """Measure no further frames; the last state stays readable. Harmless when it has ended already."""
    return _shown(request, runs.stop(test_id))


@router.get(
    "/live/events",
    summary="Live values, as server-sent events",
    response_class=EventSourceResponse,
    responses=errors(404, 503),
    dependencies=[EventStream],
)
async def live_events(service: ServiceDep, run: RunDep) -> AsyncIterator[ServerSentEvent]:
    """Follow the values: an event `values` for each measured frame, and for each loss; it begins with the newest.

    A reader that is too slow gets an event `gap` in place of the missed events. The same values, as JSON text messages,
    come by the WebSocket `/tests/{test_id}/live/ws`.
    """
    with service.streams.counted("events"):
        number = run.hub.last_number
        yield ServerSentEvent(data=run.newest(), event="values", id=str(number))
        async for event in run.hub.follow(number):
            yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))


@router.websocket("/live/ws")
async def live_socket(socket: WebSocket, test_id: str) -> None:
    """Send the values of each frame as JSON; messages of the client are ignored."""
    service: Service = socket.app.state.service
    runs: LiveRuns = socket.app.state.live_runs
    try:
        service.streams.check("events")
        run = runs.of(test_id)
    except StereorigError as error:
        await socket.close(_REFUSED, error.code)
        return
    await socket.accept()
    with service.streams.counted("events"):
        async with anyio.create_task_group() as tasks:

            async def listen() -> None:
                try:
                    while True:
                        await socket.receive()
                except (WebSocketDisconnect, RuntimeError):
                    tasks.cancel_scope.cancel()

            tasks.start_soon(listen)
            try:
                number = run.hub.last_number
                await socket.send_text(json.dumps(run.newest()))
                async for event in run.hub.follow(number):
                    if event.name == "values":
                        await socket.send_text(json.dumps(event.data))
                await socket.close()
            except (WebSocketDisconnect, RuntimeError):  # it went while it was written to
                pass
            tasks.cancel_scope.cancel()


@router.get("/live/history", summary="The last minutes of the live values", responses=errors(404, 422))
def live_history(
    run: RunDep,
    after: Annotated[int, Query(ge=0, le=2**53, description="Number of the last frame that the caller has.")] = 0,
    limit: Annotated[int, Query(ge=1, le=_MAX_FRAMES, description="Frames at most.")] = 1000,
) -> LiveHistory:
    """Return frames after a number, with the channels at the time of their exposure; 6000 frames are kept."""
    return LiveHistory.model_validate({"frames": run.series.history(after, limit)})


@router.get("/live/field", summary="The newest displacements of all points", responses=errors(404, 409))
def live_field(run: RunDep) -> LiveField:
    """Return the coarse field; 409 `no_results` if it was not asked for, or no frame was measured yet."""
    newest, grid = run.field, run.begun.get("field")
    if newest is None or grid is None:
        raise StateError(
            "There is no field yet.", code="no_results", remedy="Begin with field = true, and wait for a frame."
        )
    number, field = newest
    parts = {name: _with_gaps(field[..., k]) for k, name in enumerate(_COMPONENTS)}
    return LiveField.model_validate({"number": number, **grid, **parts})


@router.get(
    "/live/field/events",
    summary="One component of the newest field, as server-sent events",
    response_class=EventSourceResponse,
    responses=errors(404, 409, 503),
    dependencies=[EventStream, Depends(known_field)],
)
async def live_field_events(
    service: ServiceDep,
    run: RunDep,
    component: Annotated[Component, Query(description="Displacement that is sent.")] = "w_mm",
    rate_hz: Annotated[float, Query(gt=0.0, le=_MAX_FIELDS_HZ, description="Events a second at most.")] = 10.0,
) -> AsyncIterator[ServerSentEvent]:
    """Follow the coarse field for pictures of it: an event `field` for the newest frame, at most so many a second.

    Its data are `number`, `x_px`, `y_px` as in `/live/field`, and the component's values by row and column.
    """
    with service.streams.counted("events"):
        sent, due_s = 0, 0.0
        async for _ in run.hub.follow(run.hub.last_number):
            newest, grid, now_s = run.field, run.begun.get("field"), time.monotonic()
            if newest is None or grid is None or newest[0] == sent or now_s < due_s:
                continue
            sent, due_s = newest[0], now_s + 1.0 / rate_hz
            values = _with_gaps(newest[1][..., _COMPONENTS.index(component)])
            data = {"number": sent, **grid, component: values}
            yield ServerSentEvent(data=data, event="field", id=str(sent))


def _with_gaps(values: NDArray[np.float32]) -> list[list[float | None]]:
    """Rows of values, to a nanometre; None without one."""
    known = np.round(values.astype(np.float64), 6).astype(object)
    known[~np.isfinite(values)] = None
    rows: list[list[float | None]] = known.tolist()
    return rows


@router.post("/live/channels", summary="Post readings of channels", responses=errors(404, 422))
def post_live_channels(run: RunDep, body: LiveReadings) -> LiveReadingsReply:
    """Take readings; between them a channel is known at each frame's exposure. All or none are taken.

    Channels that the rig file names (`[[live.channels]]`) are read by the service, and not posted.
    """
    arrived = time.monotonic()
    readings = [(arrived if one.time_s is None else one.time_s, one.channels) for one in body.readings]
    run.lines.refuse_posted({name for _, channels in readings for name in channels})
    return LiveReadingsReply(taken=run.series.put(readings))


@router.post(
    "/live/channels:align", summary="Estimate the offset of a channel's clock", responses=errors(404, 409, 422)
)
async def align_channel(run: RunDep, body: AlignRequest) -> AlignReply:
    """Compare a channel with a gauge over the last minutes: both must have seen a knock, or a ramp begin or end."""
    found = await run_in_threadpool(
        run.series.align, body.channel, body.gauge, body.quantity, body.within_s, keep=body.keep
    )
    return AlignReply.model_validate(asdict(found))
