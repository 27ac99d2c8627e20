"""Tests and their steps."""

from __future__ import annotations

from typing import Annotated, Any, Literal, cast

import cv2
from fastapi import APIRouter, File, Form, Query, Request, UploadFile
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, Response
from pydantic import TypeAdapter, ValidationError

from stereorig.core.errors import InputError
from stereorig.server.api.models import (
    BurstAccepted,
    Channels,
    Label,
    ReadingRequest,
    RecordAccepted,
    RecordRequest,
    StepList,
    StepPatch,
    StepReply,
    StepRequest,
    TestList,
    TestPatch,
    TestReply,
    TestRequest,
    Timestamp,
    utc_text,
)
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import (
    Attached,
    Camera,
    KeyHeader,
    ServiceDep,
    StepNumber,
    TestId,
    Wait,
    get_service,
    job_reply,
    mark,
)
from stereorig.server.api.protocol.paging import WHOLE, PageDep, cursor_of
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import FormNumber, Ids
from stereorig.server.documents.steps import StepMetadata
from stereorig.server.formats.images import read_image
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.store.indexing.entries import step_entry, test_entry
from stereorig.server.wording import problems_in
from stereorig.server.workflows.analysis.listed import with_states
from stereorig.server.workflows.burst import start_burst
from stereorig.server.workflows.capture import capture_step, import_step
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.test_start import create, give_calibration

router = APIRouter(prefix="/tests", tags=["tests"])
_CHANNELS: TypeAdapter[dict[str, float]] = TypeAdapter(Channels)


def _reply(service: Service, test_id: str) -> dict[str, object]:
    steps = service.catalog.entries("step", test_id, limit=WHOLE)
    n_steps = len(steps) if len(steps) < WHOLE else service.catalog.count_entries("step", test_id)
    return {
        **service.tests.read(test_id).shown(),
        "n_steps": n_steps,
        "steps": steps,
        "steps_next_cursor": None if n_steps <= WHOLE else cursor_of(f"{steps[-1]['n']:04d}"),
        "newest_step": service.catalog.last_entry("step", test_id),
        "incomplete_steps": service.tests.steps.incomplete(test_id),
        # a browser keeps the answer as long as its ETag stays: the states are part of it
        "analyses": with_states(service, test_id, service.catalog.entries("analysis", test_id)),
    }


def _shown(service: Service, test_id: str, reply: dict[str, object]) -> TestReply:
    analyses = cast("list[dict[str, object]]", reply["analyses"])
    entries = service.checks.with_warnings(test_id, analyses)
    return TestReply.model_validate({**reply, "analyses": entries})


@router.post("", summary="Make a test", status_code=201, responses=errors(404, 409, 422, 507))
def create_test(service: ServiceDep, body: TestRequest, key: KeyHeader = None) -> TestReply:
    """Make a test; it gets its own copy of the calibration."""
    request = mark("tests", key, body)

    def make() -> Ids:
        return create(service, body.model_dump(), request)

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return _shown(service, str(made["test_id"]), _reply(service, str(made["test_id"])))


@router.get("", summary="Tests, oldest first", responses=errors(422))
def list_tests(service: ServiceDep, page: PageDep) -> TestList:
    """Return a page of the tests."""
    rest = service.catalog.entries("test", after=page.after, limit=page.limit + 1)
    return TestList.model_validate({"tests": page.cut(rest, lambda t: str(t["id"])), "next_cursor": page.next_cursor})


@router.get("/{test_id:plain_id}", summary="One test", responses=errors(404))
def get_test(service: ServiceDep, test_id: TestId, response: Response) -> TestReply:
    """Return a test with its analyses and its first 100 steps; the header ETag names this state of it.

    `n_steps` is their number; the others come from `GET /tests/{id}/steps`, beginning with `steps_next_cursor`.
    """
    return _shown(service, test_id, tagged(response, _reply(service, test_id)))


@router.patch(
    "/{test_id:plain_id}",
    summary="Change a test's name, specimen, notes or calibration",
    responses=errors(404, 409, 412, 422, 428, 507),
)
def patch_test(
    service: ServiceDep, test_id: TestId, body: TestPatch, response: Response, if_match: IfMatch = None
) -> TestReply:
    """Change the given parts; If-Match names the state of the test that was meant.

    New analyses are measured with the new calibration; earlier analyses keep the one that they were made with.
    """
    service.tests.path(test_id)
    changes = {k: v for k, v in body.model_dump(exclude_unset=True).items() if v is not None}
    with service.changes:  # no other change comes between the check and this one
        require_match(if_match, etag_of(_reply(service, test_id)), f"test {test_id}")
        calibration_id = changes.pop("calibration_id", None)
        if calibration_id is not None:
            give_calibration(service, test_id, str(calibration_id), in_force=True)
        document = service.tests.update(test_id, changes)
        service.catalog.put_entry("test", "", test_id, test_entry(document))
        return _shown(service, test_id, tagged(response, _reply(service, test_id)))


@router.post(
    "/{test_id}/steps",
    summary="Capture a step, or a burst of steps",
    response_model=StepReply,
    status_code=201,
    responses=errors(404, 409, 422, 503, 507)
    | {
        201: {"description": "One step, durable on disk"},
        202: {"model": BurstAccepted, "description": "A burst was begun; follow its job"},
    },
)
async def create_step(
    request: Request,
    test_id: TestId,
    body: StepRequest,
    attached: Attached = False,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> Any:
    """Capture a synchronised pair. When this answers, both images and `step.json` are durable on disk.

    With `count` above 1 the answer is 202 and a job, which takes a step every `interval_ms`. Its `result` lists each
    step once it is durable, with number, checksums and quality code; a pair that is refused is listed under `failures`
    and the burst continues. `attached=true` answers when the burst has ended.
    """
    service = get_service(request)
    if body.count > 1:
        job_id = await run_in_threadpool(_start_burst, service, test_id, body, key)
        reply = await job_reply(request, service, job_id, attached, wait)
        return JSONResponse(BurstAccepted.model_validate(reply).model_dump(mode="json"), status_code=202)
    return await run_in_threadpool(_capture, service, test_id, body, key)


@router.post(
    "/{test_id}/record",
    summary="Record both cameras, and keep steps by a trigger",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def record(
    request: Request,
    test_id: TestId,
    body: RecordRequest,
    attached: Attached = False,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> RecordAccepted:
    """Take pairs at the cameras' full rate into memory; keep as steps those around a trigger, or at a channel's cycles.

    The answer is a job that holds the cameras; `limits` of its `result` are the rate, times, pairs and memory that it
    keeps to. A ring that does not fit is refused (`recording_too_large`). Steps are made behind the recording, several
    at once; one is acknowledged when `result` or an event `step` lists it, and is on disk by then: a kill loses those
    that are not. `account` of the result has every pair: kept, not chosen, or dropped with its cause.
    """
    service, recordings = get_service(request), request.app.state.recordings
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/record", key, body)
    metadata = StepMetadata.model_validate({"label": body.label, **sent.document()})

    def make() -> Ids:
        return {"job_id": recordings.start(test_id, metadata, body, sent)}

    made, _ = await run_in_threadpool(service.once, sent.scope, key, sent.body_sha256, make)
    return RecordAccepted.model_validate(await job_reply(request, service, str(made["job_id"]), attached, wait))


@router.post("/{test_id}/record:trigger", summary="Trigger a recording now", responses=errors(404, 409))
async def trigger_record(request: Request, service: ServiceDep, test_id: TestId) -> RecordAccepted:
    """Trigger the recording of this test before its own trigger; a recording of cycles ends."""
    service.tests.path(test_id)
    return RecordAccepted.model_validate(
        await job_reply(request, service, request.app.state.recordings.trigger(test_id))
    )


def step_metadata(body: StepRequest | ReadingRequest, sent: RequestMark) -> StepMetadata:
    """Metadata of a step as the client states them, in the form its document keeps."""
    stamp = None if body.timestamp_utc is None else utc_text(body.timestamp_utc)
    stated = {"label": body.label, "load_n": body.load_n, "timestamp_utc": stamp, "channels": body.channels}
    return StepMetadata.model_validate({**stated, **sent.document()})


def _capture(service: Service, test_id: str, body: StepRequest, key: str | None) -> StepReply:
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/steps", key, body)

    def make() -> Ids:
        return {"n": capture_step(service, test_id, step_metadata(body, sent), frames=body.frames).n}

    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    return StepReply.model_validate(step_reply(service, test_id, int(made["n"])))


def _start_burst(service: Service, test_id: str, body: StepRequest, key: str | None) -> str:
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/steps", key, body)

    def make() -> Ids:
        job_id = start_burst(
            service,
            test_id,
            step_metadata(body, sent),
            count=body.count,
            interval_ms=body.interval_ms,
            frames=body.frames,
            request=sent,
        )
        return {"job_id": job_id}

    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    return str(made["job_id"])


def _readings(text: str | None) -> dict[str, float] | None:
    """Read the channels of a form: JSON in a text field, which the description of a form cannot specify."""
    try:
        return None if text is None else _CHANNELS.validate_json(text)
    except ValidationError as error:
        first = problems_in(error)[0]
        raise InputError(
            f"channels{first.field and '.'}{first.field}: {first.problem}.",
            code="channels_unreadable",
            remedy='Send a JSON object of numbers, as in {"stroke_mm": 0.42}.',
        ) from error


@router.post(
    "/{test_id}/steps:import",
    summary="Import a pair of image files as a step",
    status_code=201,
    responses=errors(404, 409, 413, 422, 507),
)
def import_images(
    service: ServiceDep,
    test_id: TestId,
    cam1: Annotated[UploadFile, File(description="Image of camera 1: TIFF, PNG, BMP or JPEG; gray, or RGB.")],
    cam2: Annotated[UploadFile, File(description="Image of camera 2.")],
    label: Annotated[Label, Form(description="Free text.")] = "",
    load_n: Annotated[FormNumber | None, Form(description="Load in newton.")] = None,
    timestamp_utc: Annotated[
        Timestamp | None, Form(description="The client's own time of this load step, with its time zone.")
    ] = None,
    channels: Annotated[
        str | None,
        Form(
            description="Any further scalar readings, as a JSON object of numbers.",
            examples=['{"stroke_mm": 0.42}'],
            max_length=20_000,
            json_schema_extra={"contentMediaType": "application/json"},
        ),
    ] = None,
    key: KeyHeader = None,
) -> StepReply:
    """Store two images as a step. File names are not used.

    Grey levels are kept to the bit; a colour image is stored as its luminance, and `grey_from` states so.
    """
    service.tests.path(test_id)
    data = {"cam1": cam1.file.read(), "cam2": cam2.file.read()}
    stamp = None if timestamp_utc is None else utc_text(timestamp_utc)
    readings = _readings(channels)
    stated = f"{label}\n{load_n}\n{stamp}\n{readings}".encode()
    request = mark(f"tests/{test_id}/steps:import", key, None, data["cam1"], data["cam2"], stated)

    def make() -> Ids:
        sent = {"label": label, "load_n": load_n, "timestamp_utc": stamp, "channels": readings or {}}
        metadata = StepMetadata.model_validate({**sent, **request.document()})
        return {"n": import_step(service, test_id, data, metadata).n}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return StepReply.model_validate(step_reply(service, test_id, int(made["n"])))


@router.get("/{test_id}/steps", summary="A test's steps, in order", responses=errors(404, 422))
def list_steps(
    service: ServiceDep,
    test_id: TestId,
    page: PageDep,
    channels: Annotated[bool, Query(description="With each step's channels.")] = False,
) -> StepList:
    """Return the complete steps."""
    service.tests.path(test_id)
    rest = service.catalog.entries("step", test_id, after=page.after, limit=page.limit + 1)
    steps = page.cut(rest, lambda s: f"{s['n']:04d}")
    if channels:
        steps = [{**one, "channels": service.tests.steps.read(test_id, one["n"]).document.channels} for one in steps]
    return StepList.model_validate({"steps": steps, "next_cursor": page.next_cursor})


def step_reply(service: Service, test_id: str, n: int) -> dict[str, object]:
    """Return a step as the API shows it."""
    return service.tests.steps.read(test_id, n).document.shown()


@router.get("/{test_id}/steps/{n}", summary="One step", responses=errors(404, 422))
def get_step(service: ServiceDep, test_id: TestId, n: StepNumber, response: Response) -> StepReply:
    """Return a step's document; the header ETag names this state of it."""
    return StepReply.model_validate(tagged(response, step_reply(service, test_id, n)))


@router.patch("/{test_id}/steps/{n}", summary="Change a step's label", responses=errors(404, 412, 422, 428, 507))
def patch_step(
    service: ServiceDep, test_id: TestId, n: StepNumber, body: StepPatch, response: Response, if_match: IfMatch = None
) -> StepReply:
    """Change the label; all else stays as it is. If-Match names the state of the step that was meant."""
    service.tests.steps.read(test_id, n)
    with service.changes:
        require_match(if_match, etag_of(step_reply(service, test_id, n)), f"step {n} of test {test_id}")
        document = service.tests.steps.update(test_id, n, {"label": body.label})
        entry = step_entry(document)
        service.catalog.put_entry("step", test_id, f"{n:04d}", entry)
    service.hub.publish("step", {"test_id": test_id, **entry})
    return StepReply.model_validate(tagged(response, step_reply(service, test_id, n)))


@router.get(
    "/{test_id}/steps/{n}/{cam:camera}",
    summary="One image of a step",
    response_class=Response,
    responses=errors(404, 409, 422) | {200: {"content": {"image/tiff": {}, "image/png": {}}}},
)
def get_step_image(
    service: ServiceDep,
    test_id: TestId,
    n: StepNumber,
    cam: Camera,
    format: Annotated[Literal["tiff", "png"], Query(description="As stored, or for looking at.")] = "tiff",  # noqa: A002
) -> Response:
    """Return the image as stored, after checking its checksum."""
    step = service.tests.steps.verified(test_id, n)
    path = step.cam1 if cam == "cam1" else step.cam2
    if format == "tiff":
        return Response(checked_bytes(path), media_type="image/tiff")
    _, data = cv2.imencode(".png", read_image(path))
    return Response(data.tobytes(), media_type="image/png")
