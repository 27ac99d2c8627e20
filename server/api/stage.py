"""The stage: where it is, moves, homing, stop."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from fastapi import APIRouter, Request

from server.api.dependencies import KeyHeader, ServiceDep, get_service, mark
from server.api.models import Accepted, HomeRequest, MoveRequest, StopReply
from server.api.problems import errors
from server.jobs import Job, Phase
from server.service import Service

router = APIRouter(prefix="/stage", tags=["stage"])


@router.get("", summary="Identity, limits and state of every axis", responses=errors(503))
def get_stage(service: ServiceDep) -> dict[str, Any]:
    """Read the controller; works while a move runs."""
    return service.rig.describe_stage()


@router.post("/moves", summary="Move axes", response_model=Accepted, status_code=202, responses=errors(409, 422, 503))
def move(service: ServiceDep, body: MoveRequest, key: KeyHeader = None) -> dict[str, Any]:
    """Start a move; its job's result holds positions read back. Targets are checked before any byte goes out."""
    rig = service.rig

    def targets() -> dict[int, float]:
        if body.positions_mm is not None:
            return dict(body.positions_mm)
        if body.dz_mm is not None:
            return rig.targets_for_dz(dict(body.dz_mm))
        by = body.by_mm or {}
        rig.check_axes(tuple(by))
        here = rig.positions_mm(tuple(by))
        return {axis: here[axis] + distance for axis, distance in by.items()}

    def make() -> dict[str, Any]:
        wanted = targets()
        rig.check_targets(wanted)

        def run(job: Job) -> dict[str, Any]:
            job.progress("moving", 0, 1)
            job.check()
            moved = rig.move(wanted)
            job.progress("moving", 1, 1)
            return {
                "axes": {str(a): {"target_mm": r.target_mm, "position_mm": r.position_mm} for a, r in moved.items()}
            }

        return {
            "job_id": _motion(
                service, "move", f"a move to {wanted}", {"targets_mm": {str(a): t for a, t in wanted.items()}}, run
            )
        }

    request = mark("moves", key, body)
    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return {"job": service.jobs.document(made["job_id"])}


@router.post("/home", summary="Home axes", response_model=Accepted, status_code=202, responses=errors(409, 422, 503))
def home(service: ServiceDep, body: HomeRequest | None = None, key: KeyHeader = None) -> dict[str, Any]:
    """Switch motors on and search home."""
    axes = tuple(body.axes) if body is not None and body.axes else service.config.axes

    def make() -> dict[str, Any]:
        service.rig.check_axes(axes)

        def run(job: Job) -> dict[str, Any]:
            found = {}
            for index, axis in enumerate(axes):
                job.progress("homing", index, len(axes))
                job.check()
                found.update(service.rig.home((axis,)))
            return {"axes": {str(a): {"position_mm": p} for a, p in found.items()}}

        return {"job_id": _motion(service, "home", f"homing of axes {list(axes)}", {"axes": list(axes)}, run)}

    request = mark("home", key, body)
    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return {"job": service.jobs.document(made["job_id"])}


def _motion(service: Service, kind: str, what: str, subject: dict[str, Any], run: Any) -> str:
    job = service.jobs.submit(kind, what, subject, [Phase("hardware", run)], on_cancel=service.stop_job)
    return job.id


@router.post("/stop", summary="Stop every axis, always", response_model=StopReply, responses=errors(503))
async def stop(request: Request) -> dict[str, Any]:
    """Stop at once: waits for no job and no lock, and cancels the hardware job if one runs."""
    arrived = time.perf_counter()
    service = get_service(request)
    cancelled = service.jobs.cancel_hardware()
    await asyncio.get_running_loop().run_in_executor(service.stop_thread, service.rig.stop)
    elapsed_ms = (time.perf_counter() - arrived) * 1e3
    if cancelled is not None:
        service.stop_until_released(cancelled)
    service.hub.publish("stage", {"stopped": True, "cancelled_job": cancelled})
    return {"stopped": True, "elapsed_ms": round(elapsed_ms, 3), "cancelled_job": cancelled}
