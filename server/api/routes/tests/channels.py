"""Channels of a test's steps from a load frame's own record."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, File, Form, UploadFile
from fastapi.responses import StreamingResponse

from stereorig.server.api.models.channels import ChannelsImported, ChannelsPreview
from stereorig.server.api.protocol.dependencies import ServiceDep, TestId
from stereorig.server.api.protocol.paging import WHOLE, cursor_of
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import FormNumber, Timestamp
from stereorig.server.cell.tables import record as read_in_cell
from stereorig.server.formats.channel_table import ChannelTable
from stereorig.server.formats.load_frames.description import RecordRead
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.workflows.channels.kept import HEADER
from stereorig.server.workflows.channels.records import ClockTie, preview_channels
from stereorig.server.workflows.channels.records import import_channels as align_and_keep

router = APIRouter(prefix="/tests/{test_id}", tags=["tests"])
_NAME = 100


def _record(
    service: ServiceDep,
    test_id: TestId,
    file: Annotated[UploadFile, File(description="CSV with a row of titles: times, then channels; units in brackets.")],
    time_column: Annotated[
        str | None,
        Form(max_length=_NAME, description="Title of the times' column, or its number; if left out, as titles say."),
    ] = None,
    decimal: Annotated[
        Literal[".", ","] | None, Form(description="Decimal mark of all numbers; if left out, as the cells decide it.")
    ] = None,
    segment: Annotated[
        int | None,
        Form(ge=0, le=9999, description="Which readings, from 1, if the clock falls or a footer follows; 0: all."),
    ] = None,
    date_order: Annotated[
        Literal["dmy", "mdy"] | None, Form(description="Of dates as 03/01/2026; if left out, as the dates decide it.")
    ] = None,
) -> tuple[ChannelTable | None, RecordRead]:
    service.tests.path(test_id)
    answers = {"time_column": time_column, "decimal": decimal, "segment": segment, "date_order": date_order}
    return read_in_cell(service.cell, file.file.read(), **answers)


def _alignment(
    starts_utc: Annotated[
        Timestamp | None, Form(description="When the record's own clock was zero; not for times of the calendar.")
    ] = None,
    at_step: Annotated[
        int | None, Form(ge=0, le=9999, description="Or: this step was taken at the record's time `at_s`.")
    ] = None,
    at_s: Annotated[FormNumber, Form(description="Time of the record at which `at_step` was taken.")] = 0.0,
    offset_s: Annotated[
        FormNumber, Form(description="Added to the record's times: seconds by which its clock is behind.")
    ] = 0.0,
    max_gap_s: Annotated[
        FormNumber | None,
        Form(
            gt=0,
            description="Largest distance of readings that are joined; three times their median distance if left out.",
        ),
    ] = None,
    load: Annotated[
        str | None,
        Form(max_length=_NAME, description="Channel that is the steps' load, in any unit of force: `force_kn`."),
    ] = None,
    replace: Annotated[bool, Form(description="Write over channels that steps have already.")] = False,
) -> ClockTie:
    return ClockTie(starts_utc, at_step, at_s, offset_s, max_gap_s, load, replace)


_Record = Annotated[tuple[ChannelTable | None, RecordRead], Depends(_record)]
_Alignment = Annotated[ClockTie, Depends(_alignment)]


@router.get(
    "/channels/readings",
    summary="All readings of a test's channels",
    response_class=StreamingResponse,
    responses=errors(404)
    | {200: {"content": {"text/csv": {"schema": {"type": "string"}}}, "description": "The readings, oldest first"}},
)
def get_readings(service: ServiceDep, test_id: TestId) -> StreamingResponse:
    """Return the readings that are on disk as CSV, each at its own rate.

    A line has the time by UTC and by the host's monotonic clock, s, the channel and the value. Readings are kept from a
    minute before the test's first step, until another test takes one.
    """
    tables = service.tests.readings(test_id)

    def lines() -> Iterator[bytes]:
        yield HEADER.encode()
        for table in tables:
            yield checked_bytes(table).partition(b"\n")[2]

    return StreamingResponse(lines(), media_type="text/csv")


@router.post(
    "/channels:import",
    summary="Import a load frame's record, aligned by time",
    responses=errors(404, 409, 413, 422, 507),
)
def import_channels(service: ServiceDep, test_id: TestId, record: _Record, how: _Alignment) -> ChannelsImported:
    """Give each step the record's channels at the time at which it was taken, between the readings around it.

    A column `Force (kN)` becomes the channel `force_kn`. Times are dates as in `2026-03-01T12:00:00.25Z` (UTC if no
    zone is stated), clock times, or seconds of the record's own clock. A step's time is its `timestamp_utc`, else
    `captured_utc`. Steps outside the record, in a gap of it, or next to an unreadable cell get nothing and
    are counted by the reason. All steps or none change. A question that the file leaves open is refused with
    `channels_unsure`, naming the option; `read` counts everything left out. The first 100 steps are listed; later ones
    have their channels in `GET /tests/{id}/steps?channels=true`.
    """
    done = align_and_keep(service, test_id, record, how)
    first = done.steps[:WHOLE]
    further = cursor_of(f"{first[-1]['n']:04d}") if len(done.steps) > WHOLE else None
    return ChannelsImported.model_validate({**done.summary, "steps": first, "steps_next_cursor": further})


@router.post(
    "/channels:preview",
    summary="Show the result that an import of a load frame's record would have",
    responses=errors(404, 413, 422),
)
def preview_record(service: ServiceDep, test_id: TestId, record: _Record, how: _Alignment) -> ChannelsPreview:
    """Return columns, units, lines left out, doubtful cells and the file's open questions; nothing changes.

    It takes the fields of `channels:import`, and shows the channels of each step, or the reason for a refusal.
    """
    found = preview_channels(service, test_id, record, how)
    return ChannelsPreview.model_validate({**found.summary, "refused": found.refused, "steps": found.steps[:WHOLE]})
