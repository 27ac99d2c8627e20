"""The specimen's frame: kept with its test, asked for as `frame=specimen`."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from stereorig.server.api.protocol.dependencies import ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Reply, Request
from stereorig.server.results.gauges.frames import frame_of_test, text_of
from stereorig.server.results.gauges.request import Alignment
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/frame", tags=["tests"])


class FrameRequest(Request):
    """Frame of a specimen."""

    frame: Alignment = Field(description="Its definition by the reference shape.")


class FrameReply(Reply):
    """Frame of a specimen."""

    frame: Alignment = Field(description="Its definition by the reference shape.")
    chosen: bool = Field(description="False: it is the default, the best plane, X along camera 1's image rows.")
    text: str = Field(description="The same in words.", examples=["aligned by plane, X along camera 1's image rows"])


def _reply(service: Service, test_id: str) -> FrameReply:
    kept = service.tests.read(test_id).plain().get("frame")
    found = frame_of_test(kept if isinstance(kept, dict) else None)
    return FrameReply(frame=found, chosen=isinstance(kept, dict), text=text_of(found))


@router.get("", summary="Frame of a specimen", responses=errors(404, 422))
def get_test_frame(service: ServiceDep, test_id: TestId) -> FrameReply:
    """Return the frame in which `frame=specimen` gives fields, gauges, exports and the report."""
    return _reply(service, test_id)


@router.put("", summary="Choose the frame of a specimen", responses=errors(404, 422, 507))
def put_test_frame(service: ServiceDep, test_id: TestId, body: FrameRequest) -> FrameReply:
    """Store a frame with the test. Results stay in the system frame; nothing is measured again."""
    service.tests.update(test_id, {"frame": body.frame.model_dump(mode="json")})
    return _reply(service, test_id)


@router.delete("", summary="Go back to the specimen's usual frame", responses=errors(404, 422, 507))
def delete_test_frame(service: ServiceDep, test_id: TestId) -> FrameReply:
    """Forget the frame that was chosen: the best plane, X along camera 1's image rows."""
    service.tests.update(test_id, {"frame": None})
    return _reply(service, test_id)
