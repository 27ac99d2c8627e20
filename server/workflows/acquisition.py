"""Jobs that first take images with the rig, then compute from them: a calibration, a noise measurement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from stereorig.server.base.models import Ids
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.service import Service


def begin_acquisition(
    service: Service,
    kind: str,
    purpose: str,
    id_name: Literal["calibration_id", "noise_id"],
    *,
    create: Callable[[Job], str],
    hardware: Callable[[Job, str], dict[str, object]],
    compute: Callable[[Job, str], dict[str, object]],
    on_end: Callable[[Job, str, str], None],
    request: RequestMark,
    on_cancel: Callable[[Job], None] | None = None,
) -> Ids:
    """Create an entry by ``create`` and the job that fills it; return both ids.

    Every phase and ``on_end`` are called with the job and the id of the new entry; see :meth:`Jobs.submit`.
    """
    made: dict[str, str] = {}

    def prepare(job: Job) -> Ids:
        made[id_name] = create(job)
        return dict(made)

    job = service.jobs.submit(
        kind,
        purpose,
        {},
        [
            Phase("hardware", lambda job: hardware(job, made[id_name])),
            Phase("compute", lambda job: compute(job, made[id_name])),
        ],
        prepare=prepare,
        request=request,
        on_end=lambda job, state: on_end(job, made[id_name], state),
        on_cancel=on_cancel,
    )
    return {**made, "job_id": job.id}
