"""Tests and their steps."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import cv2
from fastapi import APIRouter, File, Form, Query, UploadFile
from fastapi.responses import Response

from core.errors import StateError
from server.api.dependencies import KeyHeader, ServiceDep, StepNumber, TestId, mark
from server.api.models import (
    CameraName,
    Label,
    Number,
    StepReply,
    StepRequest,
    TestList,
    TestPatch,
    TestReply,
    TestRequest,
)
from server.api.problems import errors
from server.capture import capture_step, import_step
from server.io.images import read_image
from server.service import Service
from server.store.index import test_entry

router = APIRouter(prefix="/tests", tags=["tests"])


def _reply(service: Service, test_id: str) -> dict[str, Any]:
    document = {k: v for k, v in service.tests.read(test_id).items() if k != "request"}
    return {
        **document,
        "steps": service.catalog.entries("step", test_id),
        "incomplete_steps": service.tests.incomplete_steps(test_id),
        "analyses": service.catalog.entries("analysis", test_id),
    }


@router.post("", summary="Make a test", response_model=TestReply, status_code=201, responses=errors(404, 409, 422, 507))
def create_test(service: ServiceDep, body: TestRequest, key: KeyHeader = None) -> dict[str, Any]:
    """Make a test; it gets its own copy of the calibration."""
    request = mark("tests", key, body)

    def make() -> dict[str, Any]:
        path = None
        if body.calibration_id is not None:
            path = service.calibrations.path(body.calibration_id) / "calibration.json"
            if not path.exists():
                state = service.calibrations.read(body.calibration_id)["state"]
                raise StateError(
                    f"Calibration {body.calibration_id} is {state}.",
                    code="calibration_not_complete",
                    remedy="Use a complete calibration.",
                    state=state,
                )
        document = service.tests.create({**body.model_dump(), **request.document()}, path)
        service.catalog.put_entry("test", "", document["id"], test_entry(document))
        service.hub.publish("test", {"test_id": document["id"]})
        return {"test_id": document["id"]}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return _reply(service, made["test_id"])


@router.get("", summary="Tests, oldest first", response_model=TestList)
def list_tests(service: ServiceDep) -> dict[str, Any]:
    """Return every test."""
    return {"tests": service.catalog.entries("test")}


@router.get("/{test_id}", summary="One test", response_model=TestReply, responses=errors(404))
def get_test(service: ServiceDep, test_id: TestId) -> dict[str, Any]:
    """Return a test with its steps and analyses."""
    return _reply(service, test_id)


@router.patch(
    "/{test_id}",
    summary="Change a test's name, specimen or notes",
    response_model=TestReply,
    responses=errors(404, 422, 507),
)
def patch_test(service: ServiceDep, test_id: TestId, body: TestPatch) -> dict[str, Any]:
    """Change what is given."""
    changes = {k: v for k, v in body.model_dump(exclude_unset=True).items() if v is not None}
    document = service.tests.update(test_id, changes)
    service.catalog.put_entry("test", "", test_id, test_entry(document))
    return _reply(service, test_id)


@router.post(
    "/{test_id}/steps",
    summary="Capture a step",
    response_model=StepReply,
    status_code=201,
    responses=errors(404, 409, 422, 503, 507),
)
def create_step(service: ServiceDep, test_id: TestId, body: StepRequest, key: KeyHeader = None) -> dict[str, Any]:
    """Capture a synchronised pair. When this answers, both images and `step.json` are durable on disk."""
    service.tests.path(test_id)
    request = mark(f"tests/{test_id}/steps", key, body)

    def make() -> dict[str, Any]:
        facts = {"label": body.label, "load_n": body.load_n, "channels": body.channels, **request.document()}
        return {"n": capture_step(service, test_id, facts, frames=body.frames)["n"]}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return _step_reply(service, test_id, made["n"])


@router.post(
    "/{test_id}/steps:import",
    summary="Import a pair of image files as a step",
    response_model=StepReply,
    status_code=201,
    responses=errors(404, 409, 413, 422, 507),
)
def import_images(
    service: ServiceDep,
    test_id: TestId,
    cam1: Annotated[UploadFile, File(description="Image of camera 1: TIFF, PNG, BMP or JPEG, gray.")],
    cam2: Annotated[UploadFile, File(description="Image of camera 2.")],
    label: Annotated[Label, Form(description="Free text.")] = "",
    load_n: Annotated[Number | None, Form(description="Load in newton.")] = None,
    key: KeyHeader = None,
) -> dict[str, Any]:
    """Store two images as a step. File names are not used; the pixels are kept to the bit."""
    service.tests.path(test_id)
    data = {"cam1": cam1.file.read(), "cam2": cam2.file.read()}
    request = mark(
        f"tests/{test_id}/steps:import", key, None, data["cam1"], data["cam2"], f"{label}\n{load_n}".encode()
    )

    def make() -> dict[str, Any]:
        facts = {"label": label, "load_n": load_n, "channels": {}, **request.document()}
        return {"n": import_step(service, test_id, data, facts)["n"]}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return _step_reply(service, test_id, made["n"])


@router.get("/{test_id}/steps", summary="A test's steps, in order", responses=errors(404))
def list_steps(service: ServiceDep, test_id: TestId) -> dict[str, Any]:
    """Return the complete steps."""
    service.tests.path(test_id)
    return {"steps": service.catalog.entries("step", test_id)}


def _step_reply(service: Service, test_id: str, n: int) -> dict[str, Any]:
    return {k: v for k, v in service.tests.step(test_id, n).document.items() if k != "request"}


@router.get("/{test_id}/steps/{n}", summary="One step", response_model=StepReply, responses=errors(404, 422))
def get_step(service: ServiceDep, test_id: TestId, n: StepNumber) -> dict[str, Any]:
    """Return a step's document."""
    return _step_reply(service, test_id, n)


@router.get(
    "/{test_id}/steps/{n}/{cam}",
    summary="One image of a step",
    response_class=Response,
    responses=errors(404, 409, 422) | {200: {"content": {"image/tiff": {}, "image/png": {}}}},
)
def get_step_image(
    service: ServiceDep, test_id: TestId, n: StepNumber, cam: CameraName,
    format: Annotated[Literal["tiff", "png"], Query()] = "tiff",  # noqa: A002
) -> Response:  # fmt: skip
    """Return the image as stored, after checking its checksum."""
    step = service.tests.verified_step(test_id, n)
    path = step.cam1 if cam == "cam1" else step.cam2
    if format == "tiff":
        return Response(path.read_bytes(), media_type="image/tiff")
    _, data = cv2.imencode(".png", read_image(path))
    return Response(data.tobytes(), media_type="image/png")
