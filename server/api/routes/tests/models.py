"""Finite element results, kept with a test to be compared with."""

from __future__ import annotations

import shutil
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, File, Form, Path, UploadFile
from starlette.concurrency import run_in_threadpool

from stereorig.core.errors import InputError
from stereorig.server.api.models.evidence.evaluations import ModelList
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, TestId, mark
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import FormNumber, Ids, one_line
from stereorig.server.cell.models import described
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.models.read import SUFFIXES, Unit, ending_of
from stereorig.server.results.models.request import ModelReading, placement_in
from stereorig.server.store.models import ModelRecord, check_file_name

router = APIRouter(prefix="/tests/{test_id}/models", tags=["tests"])
ModelId = Annotated[str, Path(max_length=40, description="Id of a model.")]
_NAME = 200
_HEAD = 1000


@router.post(
    "", summary="Keep a finite element result with a test", status_code=201, responses=errors(404, 409, 413, 422, 507)
)
async def create_model(
    service: ServiceDep,
    test_id: TestId,
    file: Annotated[
        UploadFile, File(description="VTU, XDMF or CSV, recognised by its name's ending or its first bytes.")
    ],
    heavy: Annotated[
        UploadFile | None, File(description="HDF5 file of an XDMF, under the name that the XDMF has for it.")
    ] = None,
    unit: Annotated[Unit | None, Form(description="Unit of length, where the file states none.")] = None,
    displacement: Annotated[
        str | None, Form(max_length=_NAME, description="Array of the nodes' displacement, or components: `ux,uy,uz`.")
    ] = None,
    time: Annotated[FormNumber | None, Form(description="Time of the state to take from a series; the last.")] = None,
    align: Annotated[
        str | None,
        Form(
            max_length=100_000,
            description="Placement of the model, in JSON; in the system frame if left out. Kinds: `given`, `3-2-1`, "
            "`markers`, `best-fit`.",
            examples=['{"kind": "best-fit"}'],
            json_schema_extra={"contentMediaType": "application/json"},
        ),
    ] = None,
    key: KeyHeader = None,
) -> ModelRecord:
    """Read a model with displacements at its nodes, and keep it. One that cannot be used is refused, and not kept.

    Its unit of length must be stated, in the file (VTK's UNITS_LABEL, an XDMF's Information, a column `x_mm`) or here.
    """
    service.tests.path(test_id)
    reading = ModelReading(unit=unit, displacement=displacement, time=time, align=placement_in(align))
    name = one_line((file.filename or "")[-_NAME:])
    ending = FilePath(name).suffix.lower() or ending_of(await file.read(_HEAD))
    await file.seek(0)
    if ending not in SUFFIXES:
        raise InputError(
            f"The model's file {name[:80]!r} ends in none of {', '.join(SUFFIXES)}.",
            code="model_unreadable",
            remedy="Give a VTU, XDMF or CSV file under its own name.",
        )
    service.require_room()
    folder = await run_in_threadpool(service.exports.new_folder)
    try:
        held = {f"model{ending}": folder / f"model{ending}"}
        await run_in_threadpool(_put, file, held[f"model{ending}"])
        if heavy is not None:
            beside = check_file_name(FilePath(heavy.filename or "").name)
            held[beside] = folder / beside
            await run_in_threadpool(_put, heavy, held[beside])
        how = reading.model_dump(include={"unit", "displacement", "time"})
        about = await run_in_threadpool(described, service.cell, held, f"model{ending}", how)
        parts = [sha256_of(path).encode() for path in held.values()]
        stated = reading.model_dump_json().encode()
        marked = mark(f"tests/{test_id}/models", key, None, *parts, stated)

        def make() -> Ids:
            document = {"name": name, "file": f"model{ending}", "reading": reading.model_dump(mode="json"), **about}
            return {"model_id": service.models.create(test_id, held, document).id}

        made, _ = await run_in_threadpool(service.once, marked.scope, key, marked.body_sha256, make)
    finally:
        await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
    return service.models.read(test_id, str(made["model_id"]))


def _put(file: UploadFile, path: FilePath) -> None:
    with path.open("wb") as out:
        shutil.copyfileobj(file.file, out)


@router.get("", summary="Models of a test, oldest first", responses=errors(404, 422))
def list_models(service: ServiceDep, test_id: TestId, page: PageDep) -> ModelList:
    """Return a page of them."""
    found = [service.models.read(test_id, model_id) for model_id in service.models.ids(test_id)]
    return ModelList(models=list(page.of(found, lambda one: one.id)), next_cursor=page.next_cursor)


@router.delete("/{model_id:plain_id}", summary="Delete a model", status_code=204, responses=errors(404, 507))
def delete_model(service: ServiceDep, test_id: TestId, model_id: ModelId) -> None:
    """Remove a model; nothing measured changes."""
    service.models.remove(test_id, model_id)
