"""The noise measurement on the rig: frames of whatever stands before the cameras, then the models in the worker."""

from __future__ import annotations

from dataclasses import asdict

from core.names import CAMERAS
from server.jobs.job import Job
from server.worker.tasks import NoiseTask, fit_noise
from server.workflows.service import Service
from server.workflows.waiting import run_task


def take_frames(service: Service, job: Job, noise_id: str, frames: int) -> dict[str, object]:
    """Hardware phase: ``frames`` pairs on disk, none averaged."""
    rig = service.rig
    taken = []
    for index in range(frames):
        job.check()
        service.require_room()
        job.progress("frames", index, frames)
        shot = rig.pair.shoot(1, job.check)
        taken += [service.noise.put_frame(noise_id, index, cam, shot.pixels[cam]) for cam in CAMERAS]
    facts = {
        "bit_depth": {cam: shot.bit_depth[cam] for cam in CAMERAS},
        "settings": {cam: asdict(rig.pair.units[cam].settings) for cam in CAMERAS},
    }
    service.noise.put_frames_done(noise_id, taken, facts)
    job.progress("frames", frames, frames)
    return {"noise_id": noise_id, "frames": frames}


def fit(service: Service, job: Job, noise_id: str) -> dict[str, object]:
    """Compute phase: ``noise.json`` is there when this returns."""
    return dict(run_task(service.worker, job, fit_noise, NoiseTask(str(service.noise.path(noise_id)))))


def close(service: Service, job: Job, noise_id: str, state: str) -> None:
    """Leave a record of a measurement that did not come to be, and tell who listens."""
    if state != "succeeded" and job.problem is not None:
        service.noise.put_failure(noise_id, {**job.problem.plain(), "job_state": state})
    service.hub.publish("noise", {"noise_id": noise_id, "state": service.noise.read(noise_id).state})
