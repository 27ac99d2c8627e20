"""Inputs of a stored analysis' steps: their images, the calibration, the settings, earlier steps."""

from __future__ import annotations

import contextlib
from pathlib import Path

from stereorig.core.errors import FileFormatError, StereorigError
from stereorig.server.compute.tasks import StepImages, StepTask, averages_of, grey_from_of
from stereorig.server.documents.tests import AnalysisRecord
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.results.layout import stored_settings
from stereorig.server.store.tests.steps import StepFiles
from stereorig.server.store.tests.tests import TestStore


def calibration_changed(where: str) -> FileFormatError:
    """Return the error for a calibration that was replaced."""
    return FileFormatError(
        f"calibration.json {where} is not the one it was made with.",
        code="calibration_changed",
        remedy="Restore the file from a backup, or make a new test with the other calibration.",
        file="calibration.json",
    )


def is_independent(document: AnalysisRecord) -> bool:
    """Return True if the steps of an analysis need no step but the reference."""
    return document.kind == "profile" or document.settings.get("start_from") == "reference"


def task_of(
    tests: TestStore,
    document: AnalysisRecord,
    n: int,
    done: dict[int, StepFiles],
    following: int | None,
    folder: Path | None = None,
) -> StepTask:
    """Return the task of one step, its inputs compared with those that the analysis was made of.

    Parameters
    ----------
    done
        Steps that were measured before and that this one may be matched against or start from, in their order.
    following
        Number of the step that will probably be asked for next.
    folder
        Where the results go, and mask and noise models lie; the analysis' own when left out.

    Raises
    ------
    FileFormatError
        ``checksum_mismatch``, ``step_changed`` or ``calibration_changed``.
    """
    test_id, displacement = document.test_id, document.kind == "displacement"
    reference = document.steps[0] if displacement else n
    ref, now = (tests.steps.verified(test_id, k) for k in (reference, n))
    for k, step in ((reference, ref), (n, now)):
        if step.document.sha256 != document.inputs.steps.get(str(k)):
            raise FileFormatError(
                f"Step {k} of test {test_id} was replaced since the analysis was made.",
                code="step_changed",
                remedy="Start a new analysis.",
            )
    calibration = tests.calibration_file(test_id, document.inputs.calibration_sha256)
    if sha256_of(calibration) != document.inputs.calibration_sha256:
        raise calibration_changed(f"of test {test_id}, on which the analysis rests,")
    settings = stored_settings(document.settings)
    earlier: dict[int, StepFiles] = {}
    if displacement and settings.reference_update != "never":
        earlier = {k: step for k, step in done.items() if k != reference}
    after = None
    if following is not None and displacement:
        with contextlib.suppress(StereorigError):  # its error is reported when the step itself is measured
            after = tests.steps.read(test_id, following)
    about = {"label": now.document.label or "", "test_step": str(n)}
    if now.document.load_n is not None:
        about["load_n"] = repr(now.document.load_n)
    folder = folder or tests.analyses.path(test_id, document.id)
    return StepTask(
        folder=folder,
        calibration=calibration,
        settings=settings,
        reference=images_of(reference, ref),
        step=images_of(n, now),
        previous=next(reversed(done), None),
        about=about,
        following=None if after is None or following is None else images_of(following, after),
        noise=folder / "noise.json" if settings.noise is not None else None,
        earlier={k: images_of(k, step) for k, step in earlier.items()},
        keeps_starts=displacement and (n == reference or not is_independent(document)),
    )


def images_of(n: int, step: StepFiles) -> StepImages:
    """Return a stored step's images as the worker gets them."""
    sha256, record = step.document.sha256, step.document.plain()
    return StepImages(
        n=n,
        files=(step.cam1, step.cam2),
        sha256=(sha256["cam1"], sha256["cam2"]),
        averages=averages_of(record),
        grey_from=grey_from_of(record),
    )
