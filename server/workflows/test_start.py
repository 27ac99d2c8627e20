"""Making a test, and giving it a calibration, of which it keeps its own copy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from stereorig.core.errors import ImageError, StateError
from stereorig.server.base.models import Ids
from stereorig.server.documents.tests import TestRecord
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.store.indexing.entries import test_entry
from stereorig.server.workflows.calibration.review import LATEST, check_not_discarded, newest_accepted
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.service import Service


def create(service: Service, wanted: Mapping[str, object], request: RequestMark) -> Ids:
    """Make a test.

    Parameters
    ----------
    wanted
        Name, specimen, notes and ``calibration_id`` (``latest``: the newest that was accepted; None: none).

    Returns
    -------
    Ids
        ``test_id``.

    Raises
    ------
    StateError
        As :func:`calibration_asked`.
    """
    path, calibration_id = None, wanted["calibration_id"]
    if calibration_id is not None:
        calibration_id, path = calibration_asked(service, str(calibration_id))
    document = service.tests.create({**wanted, "calibration_id": calibration_id, **request.document()}, path)
    service.catalog.put_entry("test", "", document.id, test_entry(document))
    service.hub.publish("test", {"test_id": document.id})
    return {"test_id": document.id}


def calibration_asked(service: Service, asked: str) -> tuple[str, Path]:
    """Return id and file of a calibration that may be measured with.

    Parameters
    ----------
    asked
        Its id, or ``latest``: the newest that was accepted.

    Raises
    ------
    NotFoundError
        There is none of that id.
    StateError
        ``calibration_not_complete``, ``calibration_discarded`` or ``no_calibration_accepted``.
    """
    calibration_id = newest_accepted(service) if asked == LATEST else asked
    path = service.calibrations.path(calibration_id) / "calibration.json"
    state = service.calibrations.read(calibration_id).state
    if state != "complete":
        raise StateError(
            f"Calibration {calibration_id} is {state}.",
            code="calibration_not_complete",
            remedy="Use a complete calibration.",
            state=state,
        )
    check_not_discarded(service, calibration_id)
    return calibration_id, path


def give_calibration(service: Service, test_id: str, asked: str, *, in_force: bool) -> TestRecord:
    """Give a test a calibration, or another one; analyses that were begun keep theirs.

    Parameters
    ----------
    asked
        See :func:`calibration_asked`.
    in_force
        New analyses are measured with it, unless they name another one.

    Raises
    ------
    StateError
        As :func:`calibration_asked`.
    ImageError
        ``image_size_mismatch`` if the test's images are not of its cameras' size.
    CameraError
        ``wrong_camera`` if they are another camera's.
    """
    calibration_id, path = calibration_asked(service, asked)
    _check_fits(service, test_id, calibration_id, path)
    return service.tests.keep_calibration(test_id, calibration_id, checked_bytes(path), in_force=in_force)


def _check_fits(service: Service, test_id: str, calibration_id: str, path: Path) -> None:
    loaded = load_calibration(path)
    sizes = {"cam1": loaded.image_size1_px, "cam2": loaded.image_size2_px}
    for n in service.tests.steps.numbers(test_id):
        step = service.tests.steps.read(test_id, n).document
        for cam, size in step.image_size_px.items():
            of = sizes.get(cam)
            if of is not None and of != size:
                raise ImageError(
                    f"Step {n}'s image of {cam} is {size[0]} x {size[1]} px, calibration {calibration_id} is for "
                    f"{of[0]} x {of[1]} px.",
                    code="image_size_mismatch",
                    remedy="Choose a calibration of the cameras that took the images.",
                )
        check_same_cameras(path, step.cameras, f"Step {n}")
