"""The guided acquisition: free poses of the target, each taken when it is at rest and new, until the goal is met.

A job holds the cameras from the first live pair to the last view; every view is on disk, with its entry in
``view.json``, before the next live pair is looked at. The points are found in a process of its own, so that neither an
analysis nor the service's answers wait for them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Literal

from stereorig.core.errors import StateError, StereorigError
from stereorig.core.names import CAMERAS
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.models import Ids
from stereorig.server.compute.functions import guide_views, look_at_pair
from stereorig.server.compute.tasks import GuideTask, Plain
from stereorig.server.formats.manifest import is_there
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.rig.cameras import CapturedPair
from stereorig.server.store.calibrations import GUIDANCE
from stereorig.server.store.durable import read_json
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.workflows.acquisition import begin_acquisition
from stereorig.server.workflows.calibration.sequence import close, fit, rig_metadata
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task

_LONGEST_RATE_S = 0.1  # between two live pairs: ten a second are more than an eye follows
_MOST_FAILURES = 5  # captures one after another
MOST_VIEWS = 200
GUIDED_PURPOSE = "a guided calibration"


UNATTENDED_S = 120.0
"""Seconds without a request for its state after which an acquisition releases the cameras; its views are kept."""


@dataclass(frozen=True)
class GuidePlan:
    """Plan of a guided acquisition.

    Parameters
    ----------
    quantity, goal_um
        It ends when the uncertainty of ``z`` or ``shape`` at the specimen is below this, um; None: by a request.
    frames
        Frames averaged for a view.
    automatic
        False: views are taken on request alone.
    rest_px
        Largest move between two live pairs of a target at rest.
    """

    quantity: Literal["z", "shape"] = "z"
    goal_um: float | None = None
    frames: int = 1
    automatic: bool = True
    rest_px: float = 1.0
    localiser: Literal["profile", "paper"] = "profile"
    label: str = ""


@dataclass(eq=False)
class _Live:
    """An acquisition at work."""

    job_id: str
    take: threading.Event = field(default_factory=threading.Event)
    finish: threading.Event = field(default_factory=threading.Event)
    look: Plain | None = None
    looks: int = 0
    rate_hz: float | None = None
    asked: float = field(default_factory=time.monotonic)


class Guides:
    """The guided acquisitions of one service; the cameras let only one be at work."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._live: dict[str, _Live] = {}

    def begin(self, plan: GuidePlan, request: RequestMark) -> Ids:
        """Make a calibration and the job that acquires its views; return both ids.

        Raises
        ------
        BusyError
            A job or another client has the cameras.
        StorageError
            ``storage_full``.
        """
        service = self._service
        service.require_room()

        def create(job: Job) -> str:
            document = {**asdict(plan), "kind": "guided", "moves": "free", "rig": rig_metadata(service.config)}
            calibration_id = service.calibrations.create(
                document | request.document() | {"job_id": job.id}, service.config.target.plain()
            )
            self._live[calibration_id] = _Live(job.id)
            return calibration_id

        return begin_acquisition(
            service,
            "calibration",
            GUIDED_PURPOSE,
            "calibration_id",
            create=create,
            hardware=lambda job, calibration_id: self._acquire(job, calibration_id, plan),
            compute=lambda job, calibration_id: fit(service, job, calibration_id),
            on_end=self._end,
            request=request,
        )

    def state(self, calibration_id: str) -> Plain:
        """Return the findings of the newest live pair, and the guidance from the views taken.

        Raises
        ------
        NotFoundError
            The calibration was not guided.
        """
        record = self._service.calibrations.read(calibration_id)
        plan = record.plan.plain()
        if plan.get("kind") != "guided":
            raise NotFoundError(f"Calibration {calibration_id} was not guided.", kind="guide")
        path = self._service.calibrations.path(calibration_id) / GUIDANCE
        guidance = read_json(path) if is_there(path) else None
        live = self._live.get(calibration_id)
        if live is not None:
            live.asked = time.monotonic()
        acquiring = live is not None and not live.finish.is_set()
        return {
            "calibration_id": calibration_id,
            "job_id": plan.get("job_id"),
            "state": "acquiring" if acquiring else "fitting" if live is not None else record.state,
            "quantity": plan["quantity"],
            "goal_um": plan["goal_um"],
            "automatic": plan["automatic"],
            "rate_hz": None if live is None else live.rate_hz,
            "looks": 0 if live is None else live.looks,
            "live": None if live is None or not acquiring else live.look,
            "guidance": guidance,
        }

    def take(self, calibration_id: str) -> None:
        """Take a view of the next live pair that shows the target to both cameras, new or not."""
        self._at_work(calibration_id).take.set()

    def finish(self, calibration_id: str) -> str:
        """End the acquisition and fit; the views of one that was interrupted are fitted by a job of their own.

        Returns
        -------
        str
            Id of the job that fits.

        Raises
        ------
        StateError
            ``calibration_complete`` if they were fitted already.
        """
        live = self._live.get(calibration_id)
        if live is not None:
            live.finish.set()
            return live.job_id
        self.state(calibration_id)
        return self._fit_again(calibration_id)

    def _fit_again(self, calibration_id: str) -> str:
        service = self._service
        if service.calibrations.read(calibration_id).state == "complete":
            raise StateError(
                f"Calibration {calibration_id} is complete.",
                code="calibration_complete",
                remedy="Begin another acquisition for further views.",
            )
        job = service.jobs.submit(
            "calibration",
            "the fit of a guided calibration",
            {"calibration_id": calibration_id},
            [Phase("compute", lambda job: fit(service, job, calibration_id))],
            on_end=lambda job, state: close(service, job, calibration_id, state),
        )
        return job.id

    def _at_work(self, calibration_id: str) -> _Live:
        live = self._live.get(calibration_id)
        if live is None or live.finish.is_set():
            state = self.state(calibration_id)["state"]
            raise StateError(
                f"The acquisition of calibration {calibration_id} has ended: it is {state}.",
                code="guide_ended",
                remedy="Begin another one (POST /calibrations:guide).",
                state=state,
            )
        return live

    # the job -------------------------------------------------------------------------------------------------------

    def _acquire(self, job: Job, calibration_id: str, plan: GuidePlan) -> dict[str, object]:
        """Hardware phase: take live pairs and views until the goal is met or a request ends it."""
        service, live = self._service, self._live[calibration_id]
        made = service.calibrations.read(calibration_id)
        task = GuideTask(str(service.calibrations.path(calibration_id)), made.plan.plain())
        views: list[Plain] = []
        with _process() as process:
            guidance = self._guided(job, process, task, views)
            failures, before = 0, None
            while not live.finish.is_set() and not guidance["reached"] and len(views) < 2 * MOST_VIEWS:
                job.check()
                begun = time.monotonic()
                if begun - live.asked > UNATTENDED_S:
                    raise StateError(
                        f"No request for the acquisition came for {UNATTENDED_S:.0f} s: the cameras are released.",
                        code="guide_unattended",
                        remedy="POST /calibrations/{id}/guide:finish fits the views taken; or begin another one.",
                    )
                job.progress("views", guidance["used"], 0)
                try:
                    captured = service.rig.pair.capture(1, job.check)
                    failures = 0
                except StereorigError:
                    failures += 1
                    if failures >= _MOST_FAILURES or job.cancelled:
                        raise
                    continue
                look = run_task(process, job, look_at_pair, task, captured.pixels, live.looks)
                # a slow look must not make a target at rest look new once more
                live.look, live.looks = look, live.looks + 1
                wanted = live.take.is_set()
                if look["seen"] and (wanted or (plan.automatic and look["still"] and look["new"])):
                    live.take.clear()
                    service.require_room()
                    if plan.frames > 1:
                        captured = service.rig.pair.capture(plan.frames, job.check)
                    views += self._kept(calibration_id, len(views) // 2, captured)
                    service.calibrations.put_views_done(calibration_id, views)
                    guidance = self._guided(job, process, task, views)
                if before is not None:
                    live.rate_hz = round(1.0 / max(begun - before, 1e-3), 2)
                before = begun
                time.sleep(max(0.0, _LONGEST_RATE_S - (time.monotonic() - begun)))
        live.finish.set()
        return {"calibration_id": calibration_id, "views": len(views) // 2, "reached": guidance["reached"]}

    def _guided(self, job: Job, process: ComputeWorker, task: GuideTask, views: list[Plain]) -> Plain:
        guidance: Plain = run_task(process, job, guide_views, task, views)
        calibration_id = str(task.plan["id"])
        self._service.calibrations.put_guidance(calibration_id, guidance)
        shown = {name: guidance[name] for name in ("taken", "used", "uncertainty", "reached", "text")}
        self._service.hub.publish("guide", {"calibration_id": calibration_id, **shown})
        return guidance

    def _kept(self, calibration_id: str, number: int, captured: CapturedPair) -> list[Plain]:
        store, devices = self._service.calibrations, self._service.rig.identities()
        views = []
        for cam in CAMERAS:
            view = {
                "index": number,
                "camera": cam,
                "device": devices[cam],
                "role": "free",
                "dz_mm": None,
                "frames": captured.frames,
                "full_scale": (2 ** captured.bit_depth[cam] - 1) * captured.scale,
                **captured.skew,
            }
            views.append(view | store.put_view(calibration_id, number, cam, captured.pixels[cam]))
        return views

    def _end(self, job: Job, calibration_id: str, state: str) -> None:
        self._live.pop(calibration_id, None)
        close(self._service, job, calibration_id, state)


@contextmanager
def _process() -> Iterator[ComputeWorker]:
    """Start the process that finds the points; it ends with the acquisition."""
    process = ComputeWorker(threads=2)
    process.start()
    try:
        yield process
    finally:
        process.shutdown()
