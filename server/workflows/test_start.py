"""Making a test, with its own copy of a calibration."""

from __future__ import annotations

from collections.abc import Mapping

from core.errors import StateError
from server.base.models import Ids
from server.jobs.idempotency import RequestMark
from server.store.index import test_entry
from server.workflows.calibration.review import LATEST, check_not_discarded, newest_accepted
from server.workflows.service import Service


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
        ``calibration_not_complete``, ``calibration_discarded`` or ``no_calibration_accepted``.
    """
    path, asked = None, wanted["calibration_id"]
    calibration_id = newest_accepted(service) if asked in LATEST else asked
    if calibration_id is not None:
        path = service.calibrations.path(str(calibration_id)) / "calibration.json"
        state = service.calibrations.read(str(calibration_id)).state
        if state != "complete":
            raise StateError(
                f"Calibration {calibration_id} is {state}.",
                code="calibration_not_complete",
                remedy="Use a complete calibration.",
                state=state,
            )
        check_not_discarded(service, str(calibration_id))
    document = service.tests.create({**wanted, "calibration_id": calibration_id, **request.document()}, path)
    service.catalog.put_entry("test", "", document.id, test_entry(document))
    service.hub.publish("test", {"test_id": document.id})
    return {"test_id": document.id}
