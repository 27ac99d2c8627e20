"""The cameras' noise: measure, list, read."""

from __future__ import annotations

import contextlib
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response

from stereorig.core.errors import FileFormatError
from stereorig.server.api.models import NoiseAccepted, NoiseList, NoiseReply, NoiseRequest
from stereorig.server.api.models.noise import NoiseFile
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, Wait, job_reply, mark
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.documents.made import MadeRecord
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.workflows import noise_sequence
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/noise", tags=["noise"])
NoiseId = Annotated[str, Path(max_length=40, description="Id of a noise measurement.")]


@router.post("", summary="Measure both cameras' noise", status_code=202, responses=errors(409, 422, 503, 507))
async def create_noise(
    request: Request, service: ServiceDep, body: NoiseRequest | None = None, wait: Wait = 0.0, key: KeyHeader = None
) -> NoiseAccepted:
    """Take frames of a scene at rest with the present settings; fit variance against grey level.

    With an even field (`even`), measure the sensors' fixed pattern and defective pixels too.
    """
    made = await run_in_threadpool(_start, service, body, key)
    reply = await job_reply(request, service, str(made["job_id"]), wait_s=wait)
    return NoiseAccepted.model_validate({**reply, "noise_id": made["noise_id"]})


def _start(service: Service, body: NoiseRequest | None, key: str | None) -> Ids:
    body = body or NoiseRequest.model_validate({})
    request = mark("noise", key, body)

    def make() -> Ids:
        return noise_sequence.begin(service, body.frames, body.label, request, even=body.even)

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return made


@router.get("", summary="Noise measurements, oldest first", responses=errors(422))
def list_noise(service: ServiceDep, page: PageDep) -> NoiseList:
    """Return every noise measurement that was begun, with its state."""
    found = []
    for noise_id in page.of(service.noise.ids(), str):
        with contextlib.suppress(FileFormatError):  # a damaged one is reported when it is read
            found.append(_shown(service.noise.read(noise_id)))
    return NoiseList.model_validate({"noise": found, "next_cursor": page.next_cursor})


@router.get("/{noise_id}", summary="One noise measurement", responses=errors(404, 409))
def get_noise(service: ServiceDep, noise_id: NoiseId) -> NoiseReply:
    """Return plan, state and, once complete, both cameras' models."""
    return _shown(service.noise.read(noise_id))


@router.get(
    "/{noise_id}/file",
    summary="noise.json as stored",
    response_class=FileResponse,
    responses=errors(404, 409) | {200: {"model": NoiseFile, "description": "The file"}},
)
def get_noise_file(service: ServiceDep, noise_id: NoiseId) -> Response:
    """Return the file, which `stereorig measure --noise` reads."""
    return Response(checked_bytes(service.noise.file(noise_id)), media_type="application/json")


def _shown(made: MadeRecord) -> NoiseReply:
    return NoiseReply.model_validate({**made.plain(), "plan": made.plan.shown()})
