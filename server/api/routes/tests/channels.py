"""Channels of a test's steps from a load frame's own record."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile

from server.api.models.channels import ChannelsImported
from server.api.protocol.dependencies import ServiceDep, TestId
from server.api.protocol.paging import WHOLE, cursor_of
from server.api.protocol.problems import errors
from server.base.models import FormNumber, Timestamp
from server.formats.channel_table import read_channel_table
from server.workflows.channels import Alignment
from server.workflows.channels import import_channels as align_and_keep

router = APIRouter(prefix="/tests/{test_id}", tags=["tests"])
_NAME = 100


@router.post(
    "/channels:import",
    summary="Import a load frame's record, aligned by time",
    responses=errors(404, 409, 413, 422, 507),
)
def import_channels(
    service: ServiceDep,
    test_id: TestId,
    file: Annotated[UploadFile, File(description="CSV with a row of titles: times, then channels; units in brackets.")],
    time_column: Annotated[
        str | None,
        Form(max_length=_NAME, description="Title of the times' column; the first that says so if left out."),
    ] = None,
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
        Form(gt=0, description="Readings further apart are not joined; three times their median distance if left out."),
    ] = None,
    load: Annotated[
        str | None, Form(max_length=_NAME, description="Channel that is the steps' load, in N or kN: `force_kn`.")
    ] = None,
    replace: Annotated[bool, Form(description="Write over channels that steps have already.")] = False,
) -> ChannelsImported:
    """Give each step the record's channels at the time at which it was taken, between the readings around it.

    A column `Force (kN)` becomes the channel `force_kn`. Times are dates as in `2026-03-01T12:00:00.25Z` (UTC where no
    zone is stated), or seconds of the record's own clock. A step's time is its `timestamp_utc`, else `captured_utc`.
    Steps outside the record, or in a gap of it, get nothing and are counted by the reason. All steps or none change.
    The first 100 steps are listed; those after them have their channels in `GET /tests/{id}/steps?channels=true`.
    """
    service.tests.path(test_id)
    table = read_channel_table(file.file.read(), time_column=time_column)
    how = Alignment(starts_utc, at_step, at_s, offset_s, max_gap_s, load, replace)
    done = align_and_keep(service, test_id, table, how)
    first = done.steps[:WHOLE]
    further = cursor_of(f"{first[-1]['n']:04d}") if len(done.steps) > WHOLE else None
    return ChannelsImported.model_validate({**done.summary, "steps": first, "steps_next_cursor": further})
