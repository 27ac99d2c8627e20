"""Deleting: into the trash, never data that a job or a capture is using."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stereorig.core.errors import StateError, StereorigError
from stereorig.server.base.models import Ids
from stereorig.server.documents.made import TrashEntry
from stereorig.server.jobs.job import ACTIVE
from stereorig.server.store.indexing.entries import calibration_entry, entries_of_test
from stereorig.server.store.indexing.lost_jobs import LostJobs
from stereorig.server.store.trash import Kind
from stereorig.server.workflows.service import Service


def delete(service: Service, kind: Kind, ids: Ids, *, by: str) -> TrashEntry:
    """Move something into the trash; return the trash's entry.

    Parameters
    ----------
    kind, ids
        As of `stereorig.server.store.trash.Trash.put`.
    by
        Who asks.

    Raises
    ------
    NotFoundError
        There is no such thing.
    StateError
        ``in_use``, with the job or capture that uses it.
    StorageError
        When the disk fails.
    """
    if "test_id" in ids:
        service.index.read(str(ids["test_id"]))
    name = _name(service, kind, ids)  # that it exists
    with service.tests.still():
        _check_unused(service, kind, ids)
        name = _name(service, kind, ids)
        trash_id = service.trash.put(service.folder, kind, ids, name=name, by=by, why="asked for")
    if kind != "noise":
        entry_id = f"{ids['n']:04d}" if kind == "step" else str(ids[f"{kind}_id"])
        parent = str(ids["test_id"]) if kind in ("step", "analysis") else ""
        service.catalog.remove_entry(kind, parent, entry_id)
    service.hub.publish("deleted", {"kind": kind, **ids, "trash_id": trash_id})
    return service.trash.entry(trash_id)


def restore(service: Service, trash_id: str) -> TrashEntry:
    """Move an entry back from the trash; return it; errors as `stereorig.server.store.trash.Trash.restore`."""
    with service.tests.still():
        entry = service.trash.restore(trash_id)
    if entry.calibration_id is not None and entry.kind == "calibration":
        known = calibration_entry(service.calibrations, entry.calibration_id)
        service.catalog.put_entry("calibration", "", entry.calibration_id, known)
    elif entry.test_id is not None and entry.kind != "noise":
        for row in entries_of_test(service.tests, entry.test_id, LostJobs(), []):
            service.catalog.put_entry(*row)
    service.hub.publish("restored", {k: v for k, v in entry.plain().items() if k in ("kind", "n") or k.endswith("_id")})
    return entry


def _name(service: Service, kind: Kind, ids: Ids) -> str:
    """Return its name; raise an error if it is not there."""
    if kind == "test":
        service.tests.path(str(ids["test_id"]))
        try:
            return str(service.tests.read(str(ids["test_id"])).name or "")
        except StereorigError:
            return ""  # damaged data can be deleted too
    if kind == "step":
        try:
            return str(service.tests.steps.read(str(ids["test_id"]), int(ids["n"])).document.label or "")
        except StereorigError as error:
            if error.code == "not_found":
                raise
            return ""
    if kind == "analysis":
        service.tests.analyses.path(str(ids["test_id"]), str(ids["analysis_id"]))
        return ""
    if kind == "calibration":
        service.calibrations.path(str(ids["calibration_id"]))
        return ""
    service.noise.path(str(ids["noise_id"]))
    return ""


def _check_unused(service: Service, kind: Kind, ids: Ids) -> None:
    certificate = service.certificates.resting_on(kind, ids)
    if certificate is not None:
        raise _in_use(
            kind,
            f"by certificate {certificate}, which rests on it",
            "Withdraw the certificate first (POST /certificates/{id}:withdraw).",
            certificate_id=certificate,
        )
    named = {k: v for k, v in ids.items() if k != "n"}

    def uses(subject: Mapping[str, object]) -> bool:
        return all(subject.get(name) == value for name, value in named.items())

    for job in service.catalog.jobs(states=ACTIVE):
        if service.jobs.is_active(job.id) and uses({**job.subject, **(job.result or {})}):
            raise _in_use(kind, f"by job {job.id} ({job.kind})", "Wait for the job or cancel it.", job_id=job.id)
    holder = service.hardware.holder
    if holder is not None and uses(holder.plain()):
        raise _in_use(kind, f"by {holder.purpose}", "Try again when that is done.")


def _in_use(kind: str, by: str, remedy: str, **more: Any) -> StateError:
    return StateError(f"The {kind} is in use {by}.", code="in_use", remedy=remedy, **more)
