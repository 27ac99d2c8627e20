"""The noise measurement on the rig: frames of the present scene, then the models in the worker."""

from __future__ import annotations

from dataclasses import asdict

from core.names import CAMERAS
from server.base.models import Ids
from server.jobs.idempotency import RequestMark
from server.jobs.job import Job
from server.worker.tasks import NoiseTask, fit_noise
from server.workflows.acquisition import begin_acquisition
from server.workflows.service import Service
from server.workflows.waiting import run_task


def begin(service: Service, frames: int, label: str, request: RequestMark) -> Ids:
    """Make a noise measurement and its job; return both ids.

    Raises
    ------
    BusyError
        Somebody has the cameras.
    StorageError
        ``storage_full``.
    """
    service.require_room()

    def create(job: Job) -> str:
        entries = {"frames": frames, "label": label, "rig": service.config.rig.name}
        return service.noise.create({**entries, **request.document(), "job_id": job.id})

    return begin_acquisition(
        service,
        "noise",
        "a noise measurement",
        "noise_id",
        create=create,
        hardware=lambda job, noise_id: take_frames(service, job, noise_id, frames),
        compute=lambda job, noise_id: fit(service, job, noise_id),
        on_end=lambda job, noise_id, state: close(service, job, noise_id, state),
        request=request,
    )


def take_frames(service: Service, job: Job, noise_id: str, frames: int) -> dict[str, object]:
    """Hardware phase: ``frames`` pairs on disk, none averaged."""
    rig = service.rig
    taken = []
    for index in range(frames):
        job.check()
        service.require_room()
        job.progress("frames", index, frames)
        captured = rig.pair.capture(1, job.check)
        taken += [service.noise.put_frame(noise_id, index, cam, captured.pixels[cam]) for cam in CAMERAS]
    entries = {
        "bit_depth": {cam: captured.bit_depth[cam] for cam in CAMERAS},
        "settings": {cam: asdict(rig.pair.units[cam].settings) for cam in CAMERAS},
    }
    service.noise.put_frames_done(noise_id, taken, entries)
    job.progress("frames", frames, frames)
    return {"noise_id": noise_id, "frames": frames}


def fit(service: Service, job: Job, noise_id: str) -> dict[str, object]:
    """Compute phase: ``noise.json`` is there when this returns."""
    return dict(run_task(service.worker, job, fit_noise, NoiseTask(str(service.noise.path(noise_id)))))


def close(service: Service, job: Job, noise_id: str, state: str) -> None:
    """Leave a record of a measurement that did not come to be, and publish the end."""
    if state != "succeeded" and job.record.problem is not None:
        service.noise.put_failure(noise_id, {**job.record.problem.plain(), "job_state": state})
    service.hub.publish("noise", {"noise_id": noise_id, "state": service.noise.read(noise_id).state})
