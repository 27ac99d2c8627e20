"""Jobs: list, look, follow, cancel."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query
from fastapi.sse import EventSourceResponse, ServerSentEvent

from server.api.dependencies import JobId, ServiceDep
from server.api.models import JobList, JobReply
from server.api.problems import errors
from server.api.system import LastEventId
from server.jobs import FINAL

router = APIRouter(prefix="/jobs", tags=["jobs"])


def known_job(service: ServiceDep, job_id: JobId) -> dict[str, Any]:
    """Return the job, or 404 before a stream begins."""
    return service.jobs.document(job_id)


@router.get("", summary="Jobs, newest first", response_model=JobList)
def list_jobs(service: ServiceDep, limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> dict[str, Any]:
    """Return jobs of this and earlier runs of the service."""
    return {"jobs": service.jobs.documents(limit)}


@router.get("/{job_id}", summary="One job", response_model=JobReply, responses=errors(404))
def get_job(service: ServiceDep, job_id: JobId) -> dict[str, Any]:
    """Return state, progress, and result or problem."""
    return service.jobs.document(job_id)


@router.post(
    "/{job_id}/cancel", summary="Cancel a job", response_model=JobReply, status_code=202, responses=errors(404, 409)
)
def cancel_job(service: ServiceDep, job_id: JobId) -> dict[str, Any]:
    """Ask the job to stop; it does within a second, and keeps what was finished."""
    return service.jobs.cancel(job_id)


@router.get(
    "/{job_id}/events",
    summary="Progress of a job, as server-sent events",
    response_class=EventSourceResponse,
    responses=errors(404),
)
async def job_events(
    service: ServiceDep, job: Annotated[dict[str, Any], Depends(known_job)], last_event_id: LastEventId = None
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job; the stream ends with the job."""
    after = service.hub.last_number if last_event_id is None else last_event_id
    job_id = job["id"]
    now = service.jobs.document(job_id)
    if last_event_id is None or now["state"] in FINAL:
        yield ServerSentEvent(data=now, event="job", id=str(after))
    if now["state"] in FINAL:
        return
    async for event in service.hub.follow(after):
        if event.data.get("id", event.data.get("job_id")) == job_id:
            yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))
            if event.name == "job" and event.data["state"] in FINAL:
                return
