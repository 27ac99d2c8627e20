"""What routes ask for: the service, the Idempotency-Key, ids in paths."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Request
from pydantic import BaseModel

from server.service import Service


def get_service(request: Request) -> Service:
    """Return the service that the app was made for."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(get_service)]
KeyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="Send the same key again after a lost reply: the request has one effect.",
    ),
]
TestId = Annotated[str, Path(max_length=40, description="Id of a test.")]
AnalysisId = Annotated[str, Path(max_length=40, description="Id of an analysis.")]
CalibrationId = Annotated[str, Path(max_length=40, description="Id of a calibration.")]
JobId = Annotated[str, Path(max_length=40, description="Id of a job.")]
StepNumber = Annotated[int, Path(ge=0, le=9999, description="Number of a step.")]


@dataclass(frozen=True)
class RequestMark:
    """An Idempotency-Key with what it stands for; kept with whatever the request made."""

    scope: str
    key: str | None
    body_sha256: str

    def document(self) -> dict[str, Any]:
        """Return what goes into the document of the thing that is made; nothing without a key."""
        if self.key is None:
            return {}
        return {"request": {"scope": self.scope, "key": self.key, "body_sha256": self.body_sha256}}


def mark(scope: str, key: str | None, body: BaseModel | None, *parts: bytes) -> RequestMark:
    """Make the mark of a request."""
    digest = hashlib.sha256(b"" if body is None else body.model_dump_json().encode())
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return RequestMark(scope, key, digest.hexdigest())
