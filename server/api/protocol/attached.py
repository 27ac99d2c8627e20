"""Answering at once, or staying with a job to its end."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Annotated

from fastapi import Query, Request

from stereorig.core.errors import StateError
from stereorig.server.api.protocol.paging import WHOLE
from stereorig.server.jobs.job import FINAL
from stereorig.server.workflows.service import Service

Attached = Annotated[
    bool,
    Query(
        description="Answer when the job has ended; should the client go away before, it is cancelled and the stage "
        "stopped (a handle that must be held)."
    ),
]
#: longest wait; proxies give up on an answer after a minute, mostly
MAX_WAIT_S = 60
Wait = Annotated[
    float,
    Query(
        ge=0,
        le=MAX_WAIT_S,
        allow_inf_nan=False,
        description="Seconds to wait, at most, for the job's end; the answer shows the job as it is then. It continues "
        "whether the client stays or not.",
    ),
]
_ATTEND_S = 0.05


async def waited(request: Request, service: Service, job_id: str, wait_s: float) -> None:
    """Return when the job has ended, the time is over or the client has gone."""
    until = time.monotonic() + wait_s
    while (
        service.jobs.document(job_id).state not in FINAL
        and (left := until - time.monotonic()) > 0.0
        and not await request.is_disconnected()
    ):
        await asyncio.sleep(min(_ATTEND_S, left))


async def job_reply(
    request: Request, service: Service, job_id: str, attached: bool = False, wait_s: float = 0.0
) -> dict[str, object]:
    """Answer at once or after a wait; or stay with the job to its end and stop it when the client goes away."""
    if not attached:
        await waited(request, service, job_id, wait_s)
    while attached and service.jobs.document(job_id).state not in FINAL:
        if await request.is_disconnected():
            with contextlib.suppress(StateError):  # it ended just now
                await asyncio.get_running_loop().run_in_executor(service.stop_thread, service.jobs.cancel, job_id)
            break
        await asyncio.sleep(_ATTEND_S)
    return {"job": service.jobs.document(job_id).bounded(WHOLE).plain()}
