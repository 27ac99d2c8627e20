"""Health, metrics, events."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header
from fastapi.responses import PlainTextResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from server.api.dependencies import ServiceDep
from server.version import software_version

router = APIRouter(tags=["system"])
LastEventId = Annotated[
    int | None,
    Header(alias="Last-Event-ID", ge=0, description="Number of the last event seen; what came after it is sent again."),
]


@router.get("/healthz", summary="Whether the service is up")
def healthz(service: ServiceDep) -> dict[str, Any]:
    """Answer quickly, whatever else is going on; says what is not well."""
    return {
        "status": "ok",
        "version": software_version(),
        "uptime_s": round(time.monotonic() - service.started_monotonic, 1),
        "rig": "fault" if service.rig.fault else "ok",
        "worker": "ready" if service.worker.ready.is_set() else "starting",
    }


@router.get("/metrics", summary="Figures for Prometheus", response_class=PlainTextResponse)
def metrics(service: ServiceDep) -> str:
    """Return the text format of Prometheus."""
    lines = [
        "# TYPE stereorig_uptime_seconds gauge",
        f"stereorig_uptime_seconds {time.monotonic() - service.started_monotonic:.1f}",
        "# TYPE stereorig_jobs_active gauge",
        f"stereorig_jobs_active {service.jobs.active_count()}",
        "# TYPE stereorig_compute_queue gauge",
        f"stereorig_compute_queue {service.jobs.waiting_count()}",
        "# TYPE stereorig_worker_starts_total counter",
        f"stereorig_worker_starts_total {service.worker.starts}",
        "# TYPE stereorig_worker_ready gauge",
        f"stereorig_worker_ready {int(service.worker.ready.is_set())}",
        "# TYPE stereorig_rig_fault gauge",
        f"stereorig_rig_fault {int(service.rig.fault is not None)}",
        "# TYPE stereorig_hardware_held gauge",
        f"stereorig_hardware_held {int(service.gate.holder is not None)}",
        "# TYPE stereorig_frames_total counter",
    ]
    if service.rig.fault is None:
        for cam, unit in service.rig.pair.units.items():
            for name, value in unit.counters().items():
                lines.append(f'stereorig_frames_total{{camera="{cam}",what="{name}"}} {value}')
    return "\n".join(lines) + "\n"


@router.get("/events", summary="Everything that happens, as server-sent events", response_class=EventSourceResponse)
async def events(service: ServiceDep, last_event_id: LastEventId = None) -> AsyncIterator[ServerSentEvent]:
    """Follow jobs, steps, results, scene and stage; resumes after `Last-Event-ID`."""
    after = service.hub.last_number if last_event_id is None else last_event_id
    async for event in service.hub.follow(after):
        yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))
