"""Watch mode: the watched channel, and the readings that are posted."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import JSONResponse

from stereorig.server.api.models import ReadingReply, ReadingRequest, WatchRequest
from stereorig.server.api.protocol.delivery import IfMatch, PreconditionFailedError, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, TestId, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.tests.tests import step_metadata
from stereorig.server.base.models import Ids
from stereorig.server.documents.steps import WatchRecord
from stereorig.server.workflows.watch import Watches


def get_watches(request: Request) -> Watches:
    """Return the watches of the app's service."""
    watches: Watches = request.app.state.watches
    return watches


WatchesDep = Annotated[Watches, Depends(get_watches)]
router = APIRouter(prefix="/tests/{test_id}", tags=["tests"])


@router.put("/watch", summary="Take a step at each change of a channel", responses=errors(404, 412, 422, 507))
def put_watch(
    service: ServiceDep,
    watches: WatchesDep,
    test_id: TestId,
    body: WatchRequest,
    response: Response,
    if_match: IfMatch = None,
) -> WatchRecord:
    """Watch a channel of the readings posted to `/tests/{id}/channels`, in place of the one watched before.

    A reading takes a step when the channel differs from its value in the newest step that has it by `threshold` or
    more; the first reading always does. The watch outlives a restart of the service. If-Match, with the ETag of GET,
    refuses if it was changed since, or a step was taken.
    """
    service.tests.path(test_id)

    def allow(now: WatchRecord | None) -> None:
        if now is None and if_match is not None:  # `*` too means something that is there
            raise PreconditionFailedError(f"Nothing is watched in test {test_id}.")
        require_match(if_match, etag_of(now), f"the watch of test {test_id}", required=False)

    return tagged(response, watches.begin(test_id, body.model_dump(), allow))


@router.get("/watch", summary="The watch on a channel", responses=errors(404))
def get_watch(watches: WatchesDep, test_id: TestId, response: Response) -> WatchRecord:
    """Return channel and threshold, and the value that the next reading is compared with; ETag names this state."""
    return tagged(response, watches.read(test_id))


@router.post("/watch:end", summary="End the watch", responses=errors(404, 507))
def end_watch(watches: WatchesDep, test_id: TestId) -> WatchRecord:
    """Take no further steps; readings are refused from now on. Harmless when it has ended already."""
    return watches.end(test_id)


@router.post(
    "/channels",
    summary="Post a reading of the channels; a step is taken if the watched one changed",
    response_model=ReadingReply,
    responses=errors(404, 409, 422, 503, 507)
    | {
        200: {"description": "Read; no step was due"},
        201: {"model": ReadingReply, "description": "A step was taken, durable on disk"},
    },
)
def post_channels(
    service: ServiceDep, watches: WatchesDep, test_id: TestId, body: ReadingRequest, key: KeyHeader = None
) -> Any:
    """Compare a reading with the last step, and capture a step if the watched channel has changed enough.

    A step holds all channels of the reading that took it; readings that take none are not kept. When this answers with
    an error, no step was taken: send the reading again.
    """
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/channels", key, body)

    def make() -> Ids:
        outcome = watches.reading(test_id, step_metadata(body, sent))
        values = {"n": outcome.n, "reason": outcome.reason, "value": outcome.value, "last_value": outcome.last_value}
        return {name: value for name, value in values.items() if value is not None}

    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    step = None if made.get("n") is None else service.tests.steps.read(test_id, int(made["n"])).document
    values: dict[str, object] = {name: made.get(name) for name in ("reason", "value", "last_value")}
    if step is not None and "reason" not in made:  # the step has it, the catalogue was lost
        value, last = (None, None) if step.watch is None else (step.watch.value, step.watch.last_value)
        values = {"reason": "first" if last is None else "changed", "value": value, "last_value": last}
    shown = None if step is None else step.shown()
    reply = ReadingReply.model_validate({"taken": step is not None, "step": shown, **values})
    return JSONResponse(reply.model_dump(mode="json"), status_code=200 if step is None else 201)
