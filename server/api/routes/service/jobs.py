"""Jobs: list, read, follow, cancel."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from stereorig.server.api.models import JobList, JobReply, JobStepList
from stereorig.server.api.protocol.dependencies import JobId, ServiceDep, Wait, waited
from stereorig.server.api.protocol.paging import WHOLE, PageDep, ShortPageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.service.system import EventStream, LastEventId
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.jobs import JobRecord
from stereorig.server.exports.request import MEDIA_CONTENT, media_type_of
from stereorig.server.jobs.events import Event
from stereorig.server.jobs.job import FINAL

router = APIRouter(prefix="/jobs", tags=["jobs"])
#: of each list in the result of a job that is listed with others
LISTED = 1


def known_job(service: ServiceDep, job_id: JobId) -> JobRecord:
    """Return the job, or 404 before a stream begins."""
    return service.jobs.document(job_id)


@router.get("", summary="Jobs, newest first", responses=errors(422))
def list_jobs(service: ServiceDep, page: ShortPageDep) -> JobList:
    """Return a page of the jobs of this and earlier runs of the service."""
    jobs = page.cut(service.jobs.documents(page.limit + 1, before=page.after, most=LISTED), lambda j: j.id)
    return JobList.model_validate({"jobs": [job.plain() for job in jobs], "next_cursor": page.next_cursor})


@router.get("/{job_id:plain_id}", summary="One job", responses=errors(404, 422))
async def get_job(request: Request, service: ServiceDep, job_id: JobId, wait: Wait = 0.0) -> JobReply:
    """Return state, progress, and result or problem; with `wait`, once the job has ended or that time is over."""
    await waited(request, service, job_id, wait)
    return JobReply.model_validate((await run_in_threadpool(service.jobs.document, job_id)).bounded(WHOLE).plain())


@router.get("/{job_id}/steps", summary="The steps that a job has taken", responses=errors(404, 422))
def job_steps(service: ServiceDep, job_id: JobId, page: PageDep) -> JobStepList:
    """Return the steps in a job's `result`, in order of their numbers; the job's document holds the first 100.

    An analysis lists its steps with their states at `GET /tests/{id}/analyses/{analysis_id}/steps`.
    """
    result = service.jobs.document(job_id).result or {}
    found = result.get("steps")
    steps = [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []
    steps = page.of(steps, lambda one: f"{one['n']:04d}")
    return JobStepList.model_validate({"steps": steps, "next_cursor": page.next_cursor})


@router.post("/{job_id}:cancel", summary="Cancel a job", status_code=202, responses=errors(404, 409, 422))
async def cancel_job(request: Request, service: ServiceDep, job_id: JobId, wait: Wait = 0.0) -> JobReply:
    """Ask the job to stop; it does within a second, and keeps its finished results."""
    cancelled = await run_in_threadpool(service.jobs.cancel, job_id)
    if wait:
        await waited(request, service, job_id, wait)
        cancelled = service.jobs.document(job_id)
    return JobReply.model_validate(cancelled.bounded(WHOLE).plain())


@router.get(
    "/{job_id}/file",
    summary="File that an export made",
    response_class=FileResponse,
    responses=errors(404, 422) | {200: {"description": "The file.", "content": MEDIA_CONTENT}},
)
def job_file(service: ServiceDep, job_id: JobId) -> FileResponse:
    """Answer with the file of an export that was a job; of other jobs there is none."""
    state = service.jobs.document(job_id).state
    kept = service.exports.kept(job_id)
    if kept is None:
        raise NotFoundError(
            f"Job {job_id} ({state}) has no file, or has none any more.", remedy="Wait for its end, or export again."
        )
    return FileResponse(kept, filename=kept.name, media_type=media_type_of(kept))


@router.get(
    "/{job_id}/events",
    summary="Progress of a job, as server-sent events",
    response_class=EventSourceResponse,
    responses=errors(404, 503),
    dependencies=[EventStream],
)
async def job_events(
    service: ServiceDep, job: Annotated[JobRecord, Depends(known_job)], last_event_id: LastEventId = None
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job; the stream ends with the job. It begins with the job as it is, or resumes after `Last-Event-ID`.

    Later events are sent again. If some are no longer kept, the job as it is now is sent instead.
    """
    hub, job_id = service.hub, job.id
    after = hub.last_number if last_event_id is None else last_event_id

    def shown() -> ServerSentEvent:
        # the number first: an event in between is sent twice rather than not at all
        number = hub.last_number
        return ServerSentEvent(data=service.jobs.document(job_id).bounded(WHOLE).plain(), event="job", id=str(number))

    if last_event_id is None:
        begin = shown()
        yield begin
        if begin.data["state"] in FINAL:
            return
    elif service.jobs.document(job_id).state in FINAL:
        left = [] if hub.gap(after) else [e for e in hub.after(after) if _of_job(e, job_id)]
        for event in left:
            yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))
        if not left or not _is_end(left[-1]):
            yield shown()
        return
    with service.streams.counted("events"):
        async for event in hub.follow(after):
            if event.name == "gap":
                now = shown()
                yield now
                if now.data["state"] in FINAL:
                    return
            elif _of_job(event, job_id):
                yield ServerSentEvent(data=event.data, event=event.name, id=str(event.number))
                if _is_end(event):
                    return


def _of_job(event: Event, job_id: str) -> bool:
    """Return True if an event is the job's own, or names the job's result."""
    return bool(event.data.get("id" if event.name == "job" else "job_id") == job_id)


def _is_end(event: Event) -> bool:
    return event.name == "job" and event.data["state"] in FINAL
