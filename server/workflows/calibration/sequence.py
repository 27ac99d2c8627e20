"""The calibration sequence: look for the target, move, settle, average, read back; back at zero, look if it is there.

Each camera travels along its own optical axis. Every position is arrived at from one side (the stage driver takes up
backlash), positions that enter the computation are read back. The fit runs in the worker once the hardware is free
again.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from stereorig.core.calibration.inputs import least_count_sigma_mm
from stereorig.core.errors import CalibrationInputError, StereorigError, TargetError
from stereorig.core.names import CAMERAS
from stereorig.server.base.models import Ids
from stereorig.server.compute.functions import find_in_pair, fit_calibration
from stereorig.server.compute.tasks import FitTask, LookTask
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job
from stereorig.server.store.indexing.entries import calibration_entry
from stereorig.server.workflows.acquisition import begin_acquisition
from stereorig.server.workflows.capture import OFF_ZERO_MM
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task

SAME_POSITION_MM = 1e-6
#: settings of ``[calibration]`` that the fit needs
_SETTINGS = ("moves", "lens", "axis_tilt_sigma_rad", "aspect_sigma")


@dataclass(frozen=True)
class CalibrationPlan:
    """Plan of a calibration.

    Parameters
    ----------
    positions_mm, held_out_mm
        dZ of the fitted positions and of those kept for the check.
    frames
        Frames averaged at each position.
    """

    positions_mm: tuple[float, ...]
    held_out_mm: tuple[float, ...]
    frames: int
    localiser: Literal["profile", "paper"]
    label: str = ""

    def stops_mm(self) -> list[float]:
        """All dZ, ascending, with zero among them: the grid is imaged there first and last."""
        return sorted({0.0, *self.positions_mm, *self.held_out_mm})


def check_plan(plan: CalibrationPlan) -> None:
    """Refuse a plan that cannot determine the cameras, before anything moves.

    Raises
    ------
    CalibrationInputError
        ``calibration_underdetermined`` or ``positions_overlap``.
    """
    fitted = np.unique(np.asarray(plan.positions_mm))
    if fitted.size < 2 or np.ptp(fitted) < SAME_POSITION_MM:
        raise CalibrationInputError(
            f"The plan fits {fitted.size} position ({', '.join(f'{p:g} mm' for p in fitted)}); with one, a camera's "
            "pinhole distance cannot be distinguished from its distance to the target.",
            remedy="Give two or more positions at least some millimetres apart.",
        )
    both = set(plan.positions_mm) & set(plan.held_out_mm)
    if both:
        raise CalibrationInputError(
            f"Position {min(both):g} mm is both fitted and held out.",
            code="positions_overlap",
            remedy="Keep the positions for the check out of the fit.",
        )


def targets_of(service: Service, plan: CalibrationPlan) -> list[dict[int, float]]:
    """Return the axis positions of every stop, each checked against the limits."""
    stops = []
    for dz in plan.stops_mm():
        targets = service.rig.targets_for_dz(dict.fromkeys(CAMERAS, dz))
        service.rig.check_targets(targets)
        stops.append(targets)
    return stops


def begin(service: Service, plan: CalibrationPlan, request: RequestMark) -> Ids:
    """Make a calibration and its job; return both ids.

    Raises
    ------
    CalibrationInputError, StateError
        A plan that would be refused before anything moves.
    BusyError
        A job or another client has the cameras.
    StorageError
        ``storage_full``.
    """
    service.require_room()
    if service.config.calibration.moves == "free":
        raise CalibrationInputError(
            'The rig file declares moves = "free": no stage position gives the position of the target.',
            code="moves_undeclared",
            remedy="POST /calibrations:guide (`stereorig guide`), or declare the part that the stage moves.",
        )
    check_plan(plan)
    targets_of(service, plan)

    def create(job: Job) -> str:
        document = plan_document(plan, service.config) | request.document() | {"job_id": job.id}
        return service.calibrations.create(document, service.config.target.plain())

    return begin_acquisition(
        service,
        "calibration",
        "a calibration",
        "calibration_id",
        create=create,
        hardware=lambda job, calibration_id: take_views(service, job, calibration_id, plan),
        compute=lambda job, calibration_id: fit(service, job, calibration_id),
        on_end=lambda job, calibration_id, state: close(service, job, calibration_id, state),
        request=request,
        on_cancel=service.stop_job,
    )


def take_views(service: Service, job: Job, calibration_id: str, plan: CalibrationPlan) -> dict[str, object]:
    """Hardware phase: every view on disk, with its read-back dZ."""
    rig = service.rig
    stops = [*plan.stops_mm(), 0.0]
    views: list[dict[str, object]] = []
    cameras = rig.identities()
    look_first(service, job, calibration_id, plan)
    for index, dz in enumerate(stops):
        job.check()
        service.require_room()
        job.progress("views", index, len(stops))
        moved = rig.move(rig.targets_for_dz(dict.fromkeys(CAMERAS, dz)), job.check)
        job.check()
        captured = rig.pair.capture(plan.frames, job.check)
        role = _role(plan, dz, last=index == len(stops) - 1)
        for cam in CAMERAS:
            axis = rig.config.camera(cam).stage_axis
            view = {
                "index": index,
                "camera": cam,
                "device": cameras[cam],
                "role": role,
                "dz_mm": rig.dz_of(cam, moved[axis].position_mm),
                "dz_commanded_mm": dz,
                "axis": axis,
                "position_mm": moved[axis].position_mm,
                "frames": captured.frames,
                "full_scale": (2 ** captured.bit_depth[cam] - 1) * captured.scale,
                **captured.skew,
            }
            views.append(view | service.calibrations.put_view(calibration_id, index, cam, captured.pixels[cam]))
    service.calibrations.put_views_done(calibration_id, views)
    job.progress("views", len(stops), len(stops))
    return {"calibration_id": calibration_id, "views": len(views)}


def look_first(service: Service, job: Job, calibration_id: str, plan: CalibrationPlan) -> None:
    """Look for the target at the stage's present position, before anything moves.

    Raises
    ------
    TargetError
        As the fit would raise it for this view; both images are kept as view 0.
    """
    rig = service.rig
    job.progress("target", 0, 1)
    captured = rig.pair.capture(plan.frames, job.check)
    full_scale: dict[str, float] = {cam: float((2 ** captured.bit_depth[cam] - 1) * captured.scale) for cam in CAMERAS}
    positions_mm = rig.positions_mm()
    task = LookTask(rig_metadata(service.config), plan.localiser, captured.pixels, full_scale)
    try:
        run_task(service.worker, job, find_in_pair, task)
    except TargetError:
        views = []
        for cam in CAMERAS:
            axis = rig.config.camera(cam).stage_axis
            view = {
                "index": 0,
                "camera": cam,
                "device": rig.identities()[cam],
                "role": "first_look",
                "dz_mm": rig.dz_of(cam, positions_mm[axis]),
                "axis": axis,
                "position_mm": positions_mm[axis],
                "frames": captured.frames,
                "full_scale": full_scale[cam],
                **captured.skew,
            }
            views.append(view | service.calibrations.put_view(calibration_id, 0, cam, captured.pixels[cam]))
        service.calibrations.put_views_done(calibration_id, views)
        raise


def _role(plan: CalibrationPlan, dz: float, *, last: bool) -> str:
    if last:
        return "zero_again"
    if dz in plan.held_out_mm:
        return "held_out"
    return "fitted" if dz in plan.positions_mm else "zero"


def fit(service: Service, job: Job, calibration_id: str) -> dict[str, object]:
    """Compute phase: find the grid in every view, adjust, check; ``calibration.json`` is there when this returns."""
    made = service.calibrations.read(calibration_id)
    views = [view.plain() for view in made.taken or []]
    task = FitTask(str(service.calibrations.path(calibration_id)), made.plan.plain(), views)
    try:
        return dict(run_task(service.worker, job, fit_calibration, task))
    finally:  # one that is rejected is kept too
        service.calibrations.take_over(calibration_id)


def way_back(service: Service) -> dict[str, object] | None:
    """Return the stage's position and the request that moves it back to dZ = 0; None if it is there or unknown."""
    rig = service.rig
    if not rig.is_open or service.config.stage is None:
        return None
    try:
        positions = rig.positions_mm()
        dz = {cam: rig.dz_of(cam, positions[rig.config.camera(cam).stage_axis]) for cam in CAMERAS}
    except (StereorigError, KeyError):  # a silent stage reports its own fault
        return None
    if max(abs(v) for v in dz.values()) <= OFF_ZERO_MM:
        return None
    where = ", ".join(f"{cam} at dZ = {v:+.3f} mm" for cam, v in dz.items())
    return {
        "dz_mm": dz,
        "move": {"dz_mm": dict.fromkeys(CAMERAS, 0.0)},
        "text": f"The stage was left off the calibrated place ({where}): POST /stage/moves with `move` takes it back.",
    }


def rig_metadata(config: RigConfig) -> dict[str, Any]:
    """Entries of the rig file that the fit needs."""
    given = config.calibration
    return {
        "name": config.rig.name,
        "simulated": config.simulated,
        "target": config.target.plain(),
        **{name: getattr(given, name) for name in _SETTINGS},
        # that the default is assumed, and not stated, lowers a verdict
        "stage_scale_sigma": given.stage_scale_sigma if "stage_scale_sigma" in given.model_fields_set else None,
        "stage_step_sigma_mm": _step_sigma_mm(config),
        "cam1": config.cam1.model_dump(mode="json"),
        "cam2": config.cam2.model_dump(mode="json"),
    }


def _step_sigma_mm(config: RigConfig) -> float:
    """Return the standard deviation of a position read back: the one stated, else by the axes' coarsest resolution."""
    stated = config.calibration.stage_step_sigma_mm
    if stated is not None:
        return stated
    if config.stage is None:
        return least_count_sigma_mm(0.0)
    axes = [config.axis(camera.stage_axis).resolution_mm or 0.0 for camera in (config.cam1, config.cam2)]
    return least_count_sigma_mm(max(axes))


def plan_document(plan: CalibrationPlan, config: RigConfig) -> dict[str, object]:
    """``plan.json``."""
    return {**asdict(plan), "rig": rig_metadata(config)}


def close(service: Service, job: Job, calibration_id: str, state: str) -> None:
    """Leave a record of a calibration that did not come to be, and put the index right."""
    if state != "succeeded" and job.record.problem is not None:
        back = way_back(service)
        if back is not None:  # the job's own reply shows it, too
            problem = job.record.problem
            job.failed(problem.model_copy(update={"context": {**problem.context, "way_back": back}}))
        service.calibrations.put_failure(calibration_id, {**job.record.problem.plain(), "job_state": state})
    entry = calibration_entry(service.calibrations, calibration_id)
    service.catalog.put_entry("calibration", "", calibration_id, entry)
    service.hub.publish("calibration", {"calibration_id": calibration_id, "state": entry["state"]})
