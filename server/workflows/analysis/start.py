"""Analyses: the checks before one is begun, beginning one, and continuing an interrupted one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.errors import InputError, StateError
from stereorig.core.settings import AnalysisSettings, NoiseRecord, StoredSettings
from stereorig.server.base.models import Ids
from stereorig.server.cell.images import mask as read_mask
from stereorig.server.compute.seeds import check_seeds
from stereorig.server.documents.tests import AnalysisRecord
from stereorig.server.formats.calibrations.in_test import calibration_id_in
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.images import read_image
from stereorig.server.formats.noise_json import load_noise
from stereorig.server.formats.version import software_version
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.results.images.projected_pattern import check_settings
from stereorig.server.results.warnings import checks
from stereorig.server.store.indexing.entries import analysis_entry
from stereorig.server.workflows.analysis.run import AnalysisRun, close
from stereorig.server.workflows.analysis.tasks import calibration_changed
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.test_start import calibration_asked, give_calibration


def steps_to_measure(service: Service, test_id: str, reference: int, wanted: list[int] | None) -> list[int]:
    """Return the steps of an analysis, the reference first.

    Raises
    ------
    StateError
        ``no_steps`` if the reference does not exist.
    InputError
        ``step_missing`` if a step that was asked for does not exist, or all are and one is gone.
    """
    there = service.tests.steps.numbers(test_id)
    if reference not in there:
        raise StateError(
            f"Test {test_id} has no step {reference} to refer to; it has {len(there)} steps.",
            code="no_steps",
            remedy="Capture or import the reference first.",
        )
    everything = wanted is None
    if wanted is None:
        wanted = [n for n in there if n > reference]
    missing = [n for n in wanted if n not in there]
    if missing:
        raise InputError(
            f"Test {test_id} has no step {missing[0]}.", code="step_missing", remedy="Ask for steps that exist."
        )
    # an incomplete step keeps its folder and its number; one that was deleted is not missed
    numbers = {*there, *service.tests.steps.incomplete(test_id), *service.tests.steps.deleted(test_id)}
    gone = [n for n in range(reference, max(numbers)) if n not in numbers]
    if gone and everything:
        raise InputError(
            f"Step {gone[0]} of test {test_id} is gone; steps up to {max(numbers)} were taken.",
            code="step_missing",
            remedy="Restore its folder from a backup, or name the steps to measure.",
        )
    return [reference, *[n for n in dict.fromkeys(wanted) if n != reference]]


def inputs_of(service: Service, test_id: str, steps: list[int], calibration: Path) -> dict[str, object]:
    """Checksums of everything that an analysis reads, fixed when it is made."""
    return {
        "calibration_sha256": sha256_of(calibration),
        "steps": {str(n): service.tests.steps.read(test_id, n).document.sha256 for n in steps},
    }


def stale_reasons(service: Service, test_id: str, document: AnalysisRecord) -> list[str]:
    """Return the inputs that are gone or were replaced since an analysis was made; see :func:`stale_inputs`."""
    return checks.stale_reasons(service.tests.path(test_id), document)


@dataclass(frozen=True)
class CalibrationCopy:
    """A test's own copy of a calibration."""

    calibration_id: str | None
    file: Path


def calibration_of(service: Service, test_id: str, calibration_id: str | None) -> CalibrationCopy:
    """Return the calibration of a new analysis: the one it names, of which the test then has a copy, or the test's.

    Raises
    ------
    StateError
        ``not_calibrated`` if the test has none, and none is named; see :func:`give_calibration`.
    FileFormatError
        ``calibration_changed`` if the copy is not the one that the test was given.
    """
    test = service.tests.read(test_id)
    sha256 = test.calibration_sha256
    if calibration_id is not None:
        wanted, path = calibration_asked(service, calibration_id)
        sha256 = sha256_of(path)
        if sha256 != test.calibration_sha256:
            test = give_calibration(service, test_id, wanted, in_force=False)
    file = service.tests.calibration_file(test_id, sha256)
    if sha256 is not None and sha256_of(file) != sha256:
        raise calibration_changed(f"of test {test_id}")
    return CalibrationCopy(calibration_id_in(test.model_dump(), sha256), file)


def check_region(
    service: Service, test_id: str, reference: int, settings: AnalysisSettings, mask: bytes | None
) -> None:
    """Refuse a region that leaves nothing to measure, before a job is made of it; see :func:`make_grid`."""
    from stereorig.core.field.region.lay_points import make_grid  # slow to load, and not every start needs it

    image = read_image(service.tests.steps.read(test_id, reference).cam1)
    make_grid(settings, None if mask is None else read_mask(service.cell, mask), (image.shape[0], image.shape[1]))


def begin(
    service: Service,
    test_id: str,
    settings: StoredSettings,
    request: RequestMark,
    *,
    kind: str,
    label: str,
    steps: list[int] | None,
    follow: bool,
    mask: bytes | None,
    noise_id: str | None,
    calibration_id: str | None = None,
) -> Ids:
    """Check everything that can be checked now, make the analysis and its job.

    Parameters
    ----------
    settings
        The requested settings, without a noise model.
    steps
        Steps to measure; None: all after the reference.
    follow
        Measure also each step that is captured later.
    mask
        Image file of camera 1's size, white where points are allowed.
    noise_id
        Noise measurement that weighs the pixels.
    calibration_id
        Calibration to measure with; None: the test's.

    Returns
    -------
    Ids
        ``analysis_id`` and ``job_id``.
    """
    check_settings(settings, displacement=kind == "displacement")
    made_with = calibration_of(service, test_id, calibration_id)
    calibration = made_with.file
    measured = steps_to_measure(service, test_id, settings.reference, steps)
    for n in measured:
        check_same_cameras(calibration, service.tests.steps.read(test_id, n).document.cameras, f"Step {n}")
    noise = None if noise_id is None else service.noise.file(noise_id)
    if noise is not None:
        record = NoiseRecord.model_validate({"noise_id": noise_id, **load_noise(noise).record()})
        settings = settings.model_copy(update={"noise": record})
    check_region(service, test_id, measured[0], settings, mask)
    if settings.seeds_cam2 is not None:
        rows, cols = read_image(service.tests.steps.read(test_id, measured[0]).cam2).shape
        check_seeds(calibration, settings, (cols, rows))
    service.require_room()
    document = {
        "kind": kind,
        "label": label,
        "calibration_id": made_with.calibration_id,
        "settings": settings.model_dump(),
        "steps": measured,
        "follow": follow,
        "software": software_version(),
        "inputs": inputs_of(service, test_id, measured, calibration),
        **request.document(),
    }

    def prepare(job: Job) -> Ids:
        run = {"job_id": job.id, **request.document()}
        stored = service.tests.analyses.create(test_id, document, mask, noise, run)
        return {"analysis_id": stored.id}

    job = submit(service, test_id, prepare, request, follow=follow)
    return {"analysis_id": str(job.subject["analysis_id"]), "job_id": job.id}


def submit(
    service: Service, test_id: str, prepare: Callable[[Job], Ids], request: RequestMark | None, *, follow: bool = False
) -> Job:
    """Queue the measurement of the analysis that ``prepare`` makes or finds.

    Raises
    ------
    QueueFullError
        Too many computations wait.
    """
    job = service.jobs.submit(
        "analysis",
        "an analysis",
        {"test_id": test_id},
        [Phase("compute", AnalysisRun(service, test_id))],
        prepare=prepare,
        request=request,
        follows=test_id if follow else None,
        on_end=lambda job, state: close(service, job, test_id, str(job.subject["analysis_id"]), state),
    )
    analysis_id = str(job.subject["analysis_id"])
    stored = service.tests.analyses.read(test_id, analysis_id)
    service.catalog.put_entry("analysis", test_id, analysis_id, analysis_entry(stored, job.id))
    return job


def continue_analysis(
    service: Service, test_id: str, analysis_id: str, request: RequestMark, *, other_version: bool = False
) -> Job:
    """Queue the steps that an analysis has not measured yet, on the same inputs, with the same settings.

    Parameters
    ----------
    other_version
        Continue although another version of the program began it.

    Raises
    ------
    StateError
        ``analysis_running``, ``analysis_finished``, ``analysis_stale`` or ``software_changed``.
    """
    with service.continuing:  # two at once would both find it idle
        return _continue(service, test_id, analysis_id, request, other_version=other_version)


def _continue(service: Service, test_id: str, analysis_id: str, request: RequestMark, *, other_version: bool) -> Job:
    document = service.tests.analyses.read(test_id, analysis_id)
    runs = service.tests.analyses.jobs(test_id, analysis_id)
    if runs and service.jobs.is_active(runs[-1].job_id):
        raise StateError(
            f"Analysis {analysis_id} is being worked on.",
            code="analysis_running",
            remedy="Follow its job, or cancel it first.",
            job_id=runs[-1].job_id,
        )
    summary = service.tests.analyses.summary(test_id, analysis_id)
    if summary is not None and summary.state == "succeeded" and not summary.steps_failed:
        raise StateError(
            f"Analysis {analysis_id} is finished: nothing is left to continue.",
            code="analysis_finished",
            remedy="Start a new analysis for other steps.",
        )
    stale = stale_reasons(service, test_id, document)
    if stale:
        raise StateError(
            f"Analysis {analysis_id} cannot continue: {'; '.join(stale)}.",
            code="analysis_stale",
            remedy="Restore the files from a backup, or start a new analysis.",
            reasons=stale,
        )
    begun_by, now = document.software, software_version()
    if begun_by != now and not other_version:
        raise StateError(
            f"Analysis {analysis_id} was begun by version {begun_by}, this is {now}: its steps might not agree.",
            code="software_changed",
            remedy="Start a new analysis, or send other_version = true.",
            begun_by=begun_by,
            now=now,
        )

    def prepare(job: Job) -> Ids:
        service.tests.analyses.add_job(test_id, analysis_id, {"job_id": job.id, **request.document()})
        return {"analysis_id": analysis_id}

    return submit(service, test_id, prepare, request, follow=document.follow)
