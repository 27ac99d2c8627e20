"""The stage: position, moves, homing, stop."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool

from stereorig.drivers.stages.refusals import configuration_state
from stereorig.server.api.models import (
    Accepted,
    AxesRequest,
    DynamicsPatch,
    DynamicsReply,
    FlashConsent,
    HomeRequest,
    MoveRequest,
    StageMessages,
    StageReply,
    StopReply,
)
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import (
    Attached,
    KeyHeader,
    ServiceDep,
    Wait,
    get_service,
    job_reply,
    mark,
)
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/stage", tags=["stage"])
Run = Callable[[Job], Mapping[str, object]]
AxisNumber = Annotated[int, Path(ge=1, le=31, description="Number of an axis.")]


@router.get(
    "", summary="Identity, limits and state of every axis", response_model_exclude_unset=True, responses=errors(503)
)
def get_stage(service: ServiceDep) -> StageReply:
    """Read the controller; works while a move runs."""
    return service.rig.describe_stage()


@router.post("/moves", summary="Move axes", status_code=202, responses=errors(409, 422, 503, 507))
async def move(
    request: Request, body: MoveRequest, attached: Attached = False, wait: Wait = 0.0, key: KeyHeader = None
) -> Accepted:
    """Start a move; its job's result holds positions read back. Targets are checked before any byte goes out."""
    service = get_service(request)
    job_id = await run_in_threadpool(_start_move, service, body, key)
    return Accepted.model_validate(await job_reply(request, service, job_id, attached, wait))


def _start_move(service: Service, body: MoveRequest, key: str | None) -> str:
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

    def make() -> Ids:
        wanted = targets()
        rig.check_targets(wanted)

        def run(job: Job) -> Mapping[str, object]:
            job.progress("moving", 0, 1)
            moved = rig.move(wanted, job.check)
            job.progress("moving", 1, 1)
            return {
                "axes": {str(a): {"target_mm": r.target_mm, "position_mm": r.position_mm} for a, r in moved.items()}
            }

        subject = {"targets_mm": {str(a): t for a, t in wanted.items()}}
        return {"job_id": _motion(service, sent, "move", _move_in_words(wanted), subject, run)}

    sent = mark("moves", key, body)
    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    return str(made["job_id"])


def _move_in_words(targets_mm: Mapping[int, float]) -> str:
    """Say where axes go, as the holder of the hardware reads to those who wait."""
    return "a move of " + " and ".join(f"axis {axis} to {target:.12g} mm" for axis, target in targets_mm.items())


@router.post(":home", summary="Home axes", status_code=202, responses=errors(409, 422, 503, 507))
async def home(
    request: Request,
    body: HomeRequest | None = None,
    attached: Attached = False,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> Accepted:
    """Switch motors on and search home."""
    service = get_service(request)
    job_id = await run_in_threadpool(_start_home, service, body, key)
    return Accepted.model_validate(await job_reply(request, service, job_id, attached, wait))


def _start_home(service: Service, body: HomeRequest | None, key: str | None) -> str:
    axes = tuple(body.axes) if body is not None and body.axes else service.config.axes

    def make() -> Ids:
        service.rig.check_axes(axes)
        for axis in service.rig.controls.in_configuration(axes):
            raise configuration_state(axis)

        def run(job: Job) -> Mapping[str, object]:
            found = {}
            for index, axis in enumerate(axes):
                job.progress("homing", index, len(axes))
                found.update(service.rig.home((axis,), job.check))
            return {"axes": {str(a): {"position_mm": p} for a, p in found.items()}}

        return {
            "job_id": _motion(service, sent, "home", f"homing of {_axes_in_words(axes)}", {"axes": list(axes)}, run)
        }

    sent = mark("home", key, body)
    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    return str(made["job_id"])


def _axes_in_words(axes: Sequence[int]) -> str:
    return f"{'axis' if len(axes) == 1 else 'axes'} {' and '.join(map(str, axes))}"


def _motion(
    service: Service, sent: RequestMark, kind: str, purpose: str, subject: Mapping[str, object], run: Run
) -> str:
    job = service.jobs.submit(
        kind,
        purpose,
        subject,
        [Phase("hardware", run)],
        on_cancel=service.stop_job,
        request=sent,
        without_disk=True,  # a stage that cannot be moved out of the way is a worse loss than its job's record
    )
    return job.id


#: sent by the front process, which has put the stop on the wire: its number and the time that it took, ms
_HALTED = "stereorig-halted"
_HALT_KNOWN_S = 0.1


@router.post(":stop", summary="Stop every axis, always", responses=errors(503))
async def stop(request: Request) -> StopReply:
    """Stop at once: waits for no job and no lock, and cancels the hardware job if one runs."""
    service = get_service(request)
    answer = await _halt(request, service.stop_thread, service.rig.stop)
    service.metrics.stop_s.observe(answer.elapsed_ms / 1e3)
    return answer


@router.post(":abort", summary="Stop every axis and switch the motors off, always", responses=errors(503))
async def abort(request: Request) -> StopReply:
    """Stop as in an emergency: as `/stage:stop`, with the controller's emergency stop, and without power afterwards."""
    service = get_service(request)
    # it waits until the motors are off, behind which no stop must wait
    return await _halt(request, service.abort_thread, service.rig.controls.abort)


async def _halt(request: Request, thread: ThreadPoolExecutor, halt: Callable[[], None]) -> StopReply:
    service, loop = get_service(request), asyncio.get_running_loop()
    halted = request.headers.get(_HALTED)
    if halted is not None and service.rig.is_remote:
        number, _, took_ms = halted.partition(";")
        find = functools.partial(service.halts.cancelled_job, int(number), _HALT_KNOWN_S)
        return StopReply(
            stopped=True, elapsed_ms=round(float(took_ms), 3), cancelled_job=await loop.run_in_executor(thread, find)
        )
    arrived = time.perf_counter()
    cancelled = service.jobs.cancel_hardware()
    await loop.run_in_executor(thread, halt)
    elapsed_ms = (time.perf_counter() - arrived) * 1e3
    service.note_stop(cancelled)
    return StopReply(stopped=True, elapsed_ms=round(elapsed_ms, 3), cancelled_job=cancelled)


@router.post(":enable", summary="Switch motors on", response_model_exclude_unset=True, responses=errors(409, 422, 503))
def enable(service: ServiceDep, body: AxesRequest | None = None) -> StageReply:
    """Switch motors on, and return the stage as it is then. An SMC100's are switched on by homing the first time."""
    return _switch(service, body, on=True)


@router.post(
    ":disable", summary="Switch motors off", response_model_exclude_unset=True, responses=errors(409, 422, 503)
)
def disable(service: ServiceDep, body: AxesRequest | None = None) -> StageReply:
    """Switch motors off, and return the stage as it is then; refused while a job uses it."""
    return _switch(service, body, on=False)


def _switch(service: Service, body: AxesRequest | None, *, on: bool) -> StageReply:
    axes = tuple(body.axes) if body is not None and body.axes else service.config.axes
    service.rig.check_axes(axes)
    with service.hardware.hold(f"the switching of the motors of {_axes_in_words(axes)}"):
        service.hardware.call(lambda: service.rig.controls.switch(axes, on=on))
    return service.rig.describe_stage()


@router.get("/axes/{axis:plain_id}", summary="An axis' velocity and acceleration", responses=errors(422, 503))
def get_axis(service: ServiceDep, axis: AxisNumber, response: Response) -> DynamicsReply:
    """Read both back from the controller; the header ETag names this state of them."""
    service.rig.check_axes((axis,))
    return tagged(response, service.rig.controls.read_dynamics(axis))


@router.patch(
    "/axes/{axis:plain_id}", summary="Set an axis' velocity and acceleration", responses=errors(409, 412, 422, 503)
)
def patch_axis(
    service: ServiceDep, axis: AxisNumber, body: DynamicsPatch, response: Response, if_match: IfMatch = None
) -> DynamicsReply:
    """Set the given values; the answer has the controller's values. They last until the service ends.

    If-Match, with the ETag of GET, refuses if others changed them.
    """
    controls = service.rig.controls
    service.rig.check_axes((axis,))
    with service.hardware.hold(f"a new velocity of axis {axis}"):
        if if_match is not None:
            now = etag_of(service.hardware.call(lambda: controls.read_dynamics(axis)))
            require_match(if_match, now, f"axis {axis}")
        taken = service.hardware.call(lambda: controls.set_dynamics(axis, body.velocity_mm_s, body.acceleration_mm_s2))
        return tagged(response, taken)


@router.post(
    "/axes/{axis}:leave-configuration",
    summary="Leave an SMC100's configuration state",
    status_code=202,
    responses=errors(409, 422, 503, 507),
)
async def leave_configuration(
    request: Request, service: ServiceDep, axis: AxisNumber, body: FlashConsent, wait: Wait = 0.0, key: KeyHeader = None
) -> Accepted:
    """Leave the state in which it refuses every motion. This writes its flash memory, and `write_flash` consents."""
    job_id = await run_in_threadpool(_start_leaving, service, axis, body, key)
    return Accepted.model_validate(await job_reply(request, service, job_id, wait_s=wait))


def _start_leaving(service: Service, axis: int, body: FlashConsent, key: str | None) -> str:

    def run(job: Job) -> Mapping[str, object]:
        job.progress("leaving the configuration state", 0, 1)
        service.rig.controls.leave_configuration(axis)
        return {"axis": axis}

    def make() -> Ids:
        service.rig.check_axes((axis,))
        purpose = f"the leaving of the configuration state of axis {axis}"
        return {"job_id": _motion(service, request, "leave_configuration", purpose, {"axis": axis}, run)}

    request = mark(f"leave-configuration/{axis}", key, body)
    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return str(made["job_id"])


@router.get("/messages", summary="Messages of the controller")
def get_messages(service: ServiceDep) -> StageMessages:
    """Empty the controller's error queue and return the last 200 messages with their texts; reading loses none."""
    return StageMessages(messages=service.rig.controls.messages())
