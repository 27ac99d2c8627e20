"""The noise measurement on the rig: frames of the present scene, then the models in the worker."""

from __future__ import annotations

from dataclasses import asdict

from stereorig.core.names import CAMERAS
from stereorig.server.base.models import Ids
from stereorig.server.compute.functions import fit_noise
from stereorig.server.compute.tasks import NoiseTask
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job
from stereorig.server.workflows.acquisition import begin_acquisition
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task


def begin(service: Service, frames: int, label: str, request: RequestMark, *, even: bool = False) -> Ids:
    """Make a noise measurement and its job; return both ids.

    Raises
    ------
    BusyError
        A job or another client has the cameras.
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
        hardware=lambda job, noise_id: take_frames(service, job, noise_id, frames, even=even),
        compute=lambda job, noise_id: fit(service, job, noise_id),
        on_end=lambda job, noise_id, state: close(service, job, noise_id, state),
        request=request,
    )


def take_frames(service: Service, job: Job, noise_id: str, frames: int, *, even: bool = False) -> dict[str, object]:
    """Hardware phase: ``frames`` pairs on disk, none averaged; ``even`` if they show an even field."""
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
        **({"even": True} if even else {}),
    }
    service.noise.put_frames_done(noise_id, taken, entries)
    job.progress("frames", frames, frames)
    return {"noise_id": noise_id, "frames": frames}


def fit(service: Service, job: Job, noise_id: str) -> dict[str, object]:
    """Compute phase: ``noise.json`` is there when this returns."""
    found = dict(run_task(service.worker, job, fit_noise, NoiseTask(str(service.noise.path(noise_id)))))
    service.noise.take_over(noise_id)
    return found


def close(service: Service, job: Job, noise_id: str, state: str) -> None:
    """Leave a record of a measurement that did not come to be, and publish the end."""
    if state != "succeeded" and job.record.problem is not None:
        service.noise.put_failure(noise_id, {**job.record.problem.plain(), "job_state": state})
    service.hub.publish("noise", {"noise_id": noise_id, "state": service.noise.read(noise_id).state})
