"""Answering at once, or staying with a job to its end."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated

from fastapi import Query, Request

from core.errors import StateError
from server.jobs.job import FINAL
from server.workflows.service import Service

Attached = Annotated[
    bool,
    Query(
        description="Answer when the job has ended; should the client go away before, it is cancelled and the stage "
        "stopped (a handle that must be held)."
    ),
]
_ATTEND_S = 0.05


async def job_reply(request: Request, service: Service, job_id: str, attached: bool) -> dict[str, object]:
    """Answer at once, or stay with the job to its end and stop it when the client goes away."""
    while attached and service.jobs.document(job_id).state not in FINAL:
        if await request.is_disconnected():
            with contextlib.suppress(StateError):  # it ended just now
                await asyncio.get_running_loop().run_in_executor(service.stop_thread, service.jobs.cancel, job_id)
            break
        await asyncio.sleep(_ATTEND_S)
    return {"job": service.jobs.document(job_id).plain()}
