"""Health, metrics, events."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Header, Request
from fastapi.responses import PlainTextResponse, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, Field

from stereorig.server.api.protocol.dependencies import ServiceDep
from stereorig.server.api.protocol.problems import RETRY_AFTER_S, errors, problem_response
from stereorig.server.base.metrics import CONTENT_TYPE
from stereorig.server.formats.version import software_version
from stereorig.server.workflows.metrics_state import metrics_text

router = APIRouter(tags=["system"])
LastEventId = Annotated[
    int | None,
    Header(alias="Last-Event-ID", ge=0, description="Number of the last event seen; later ones are sent again."),
]


class ReadyReply(BaseModel):
    """Return True if the service can do its work."""

    ready: bool = Field(description="True.")


class HealthReply(BaseModel):
    """State of the service's parts."""

    status: Literal["ok"] = Field(description="The service answers.")
    version: str = Field(description="Version of the program.")
    uptime_s: float = Field(description="For how long it has been running.")
    rig: Literal["ok", "fault"] = Field(
        description="`ok`: cameras and stage are open; `fault`: the reason is in GET /rig."
    )
    worker: Literal["ready", "starting"] = Field(description="`ready` to compute, or still `starting`.")
    tests_to_read: int = Field(
        0,
        description="Tests that are still to be read into the catalogue, after a start that no clean stop came before; "
        "one that is asked for is read at once.",
    )
    live_test_id: str | None = Field(None, description="Test that is measured live now; null: none.")


@router.get("/healthz", summary="Liveness")
def healthz(request: Request, service: ServiceDep) -> HealthReply:
    """Answer quickly, even while jobs run, with the parts that are not well."""
    live = request.app.state.live_runs.current
    return HealthReply.model_validate(
        {
            "status": "ok",
            "version": software_version(),
            "uptime_s": round(time.monotonic() - service.started_monotonic, 1),
            "rig": "fault" if service.rig.fault else "ok",
            "tests_to_read": service.index.waiting(),
            "live_test_id": live.test_id if live is not None and live.active else None,
            "worker": "ready" if service.worker.ready.is_set() else "starting",
        }
    )


@router.get("/readyz", summary="Readiness to capture and compute", response_model=ReadyReply, responses=errors(503))
def readyz(service: ServiceDep) -> object:
    """Answer 200 when rig, worker and disk are ready; else a problem whose `reasons` hold code and cause each."""
    reasons = service.not_ready()
    if not reasons:
        return ReadyReply(ready=True)
    return problem_response(
        503,
        "not_ready",
        " ".join(reason["cause"] for reason in reasons),
        "Wait where something is starting; else see GET /rig, and the room on the disk.",
        headers={"Retry-After": str(RETRY_AFTER_S)},
        ready=False,
        reasons=reasons,
    )


@router.get("/metrics", summary="Figures for Prometheus", response_class=PlainTextResponse)
def metrics(service: ServiceDep) -> Response:
    """Return the text format of Prometheus: requests, captures, jobs, queue, cameras, disk, worker, stage, process."""
    return Response(metrics_text(service), media_type=CONTENT_TYPE)


def _event_stream(service: ServiceDep) -> None:
    """Refuse one too many before its answer begins."""
    service.streams.check("events")


#: for every operation that streams events
EventStream = Depends(_event_stream)


@router.get(
    "/events",
    summary="Everything that happens, as server-sent events",
    response_class=EventSourceResponse,
    responses=errors(503),
    dependencies=[EventStream],
)
async def events(service: ServiceDep, last_event_id: LastEventId = None) -> AsyncIterator[ServerSentEvent]:
    """Follow jobs, steps, results, scene and stage; resumes after `Last-Event-ID`, also over a restart.

    `camera` and `stage` have a `state` when a camera, or a stage's controller, is `lost` or `connected`.

    If events are lost to the reader, because it was away for long, too slow, or the service was started again, an
    event `gap` comes first: `next` is the first number that is available. The reader must request its data again.
    """
    after = service.hub.last_number if last_event_id is None else last_event_id
    with service.streams.counted("events"):
        async for event in service.hub.follow(after):
            yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))
