"""Repair of a calibration after a camera was bumped: a new calibration from the steps of a test, the old one kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stereorig.core.errors import StateError
from stereorig.server.base.models import Ids
from stereorig.server.compute.functions import repair_calibration
from stereorig.server.compute.tasks import RepairTask, StepImages, averages_of
from stereorig.server.formats.manifest import is_there
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.store.calibrations import REJECTED
from stereorig.server.workflows.calibration.sequence import close
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task


def begin(
    service: Service,
    calibration_id: str,
    request: RequestMark,
    *,
    test_id: str,
    steps: Sequence[int],
    region: dict[str, Any] | None,
    mask: bytes | None,
    subset_px: int,
    spacing_px: int | None,
    limits: dict[str, float],
    label: str,
) -> Ids:
    """Make a new calibration and the job that repairs it; return both ids.

    Parameters
    ----------
    calibration_id
        The calibration to repair, which stays as it is.
    test_id, steps
        Images taken after the bump.
    mask
        Image file of camera 1's size, white where points are allowed.
    region, subset_px, spacing_px, limits
        As :class:`stereorig.server.compute.tasks.RepairTask`.

    Raises
    ------
    NotFoundError
        No such calibration, test or step.
    StateError
        ``calibration_not_complete``.
    CameraError
        ``wrong_camera``: the steps were taken with other cameras.
    FileFormatError
        ``checksum_mismatch``.
    StorageError
        ``storage_full``.
    """
    service.require_room()
    original = service.calibrations.path(calibration_id) / "calibration.json"
    if not is_there(original):
        state = service.calibrations.read(calibration_id).state
        rejected = (original.parent / REJECTED).exists()
        raise StateError(
            f"Calibration {calibration_id} is {state}.",
            code="calibration_not_complete",
            remedy="Calibrate again." if rejected else "Wait for its job, or calibrate again.",
            state=state,
        )
    images = []
    for n in dict.fromkeys(steps):
        step = service.tests.steps.verified(test_id, n)
        check_same_cameras(original, step.document.cameras, f"Step {n}")
        sha256 = step.document.sha256
        averages = averages_of(step.document.plain())
        images.append(
            StepImages(n=n, files=(step.cam1, step.cam2), sha256=(sha256["cam1"], sha256["cam2"]), averages=averages)
        )
    made: dict[str, str] = {}

    def prepare(job: Job) -> Ids:
        plan = {
            "source": "repair",
            "label": label,
            "repaired_from": calibration_id,
            "original_sha256": service.calibrations.checksum(calibration_id),
            "test_id": test_id,
            "steps": [image.n for image in images],
            "limits": limits,
            **request.document(),
            "job_id": job.id,
        }
        made["calibration_id"] = service.calibrations.create_repaired(plan, mask)
        return dict(made)

    def work(job: Job) -> dict[str, object]:
        folder = service.calibrations.path(made["calibration_id"])
        task = RepairTask(
            folder=folder,
            original=original,
            steps=images,
            region=region,
            mask=None if mask is None else folder / "mask.png",
            subset_px=subset_px,
            spacing_px=spacing_px,
            limits=limits,
        )
        found = dict(run_task(service.worker, job, repair_calibration, task))
        service.calibrations.take_over(made["calibration_id"])
        return found

    job = service.jobs.submit(
        "calibration_repair",
        "a repair of a calibration",
        {},
        [Phase("compute", work)],
        prepare=prepare,
        request=request,
        on_end=lambda job, state: close(service, job, made["calibration_id"], state),
    )
    return {**made, "job_id": job.id}
