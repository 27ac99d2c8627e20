"""Validity of a certificate: its inputs are as they were."""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime
from typing import Literal

from stereorig.core.errors import StereorigError
from stereorig.server.documents.made import CertificateRecord
from stereorig.server.workflows.service import Service

CertificateState = Literal["valid", "failed", "expired", "void", "withdrawn"]


def state_of(service: Service, record: CertificateRecord) -> tuple[CertificateState, str]:
    """Return a certificate's state now, and why; it is void once another calibration was made after it."""
    withdrawn = service.certificates.withdrawn(record.id)
    if withdrawn is not None:
        return "withdrawn", f"withdrawn by {withdrawn.get('by')}: {withdrawn.get('reason')}"
    if record.outcome == "fail":
        return "failed", "the verdict is fail"
    until = record.valid_until_utc
    if until is None or datetime.now(UTC) > datetime.fromisoformat(until):
        return "expired", f"it held until {until}"
    newer = _newer_calibration(service, record)
    if newer is not None:
        return "void", f"calibration {newer} was made after it"
    return "valid", ""


def _newer_calibration(service: Service, record: CertificateRecord) -> str | None:
    made = datetime.fromisoformat(record.created_utc)
    for calibration_id in reversed(service.calibrations.ids()):
        with contextlib.suppress(StereorigError, ValueError):  # one that is damaged voids nothing
            found = service.calibrations.read(calibration_id)
            if datetime.fromisoformat(found.plan.created_utc) <= made:
                return None
            changed = found.state == "complete"
            if changed and service.calibrations.checksum(calibration_id) != record.made_of.calibration_sha256:
                return calibration_id
    return None
