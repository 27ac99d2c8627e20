"""Metadata of a test: read and replaced as a whole."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Response

from stereorig.core.errors import StateError
from stereorig.server.api.protocol.delivery import etag_of, tagged
from stereorig.server.api.protocol.dependencies import ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.results.metadata import TestMetadata

router = APIRouter(prefix="/tests/{test_id}", tags=["tests"])


@router.get("/metadata", summary="Metadata of a test", response_model_exclude_none=True, responses=errors(404))
def get_metadata(service: ServiceDep, test_id: TestId, response: Response) -> TestMetadata:
    """Return the metadata, empty if none were stated; the header ETag names this state of them."""
    return TestMetadata.model_validate(tagged(response, service.tests.metadata(test_id)))


@router.put(
    "/metadata",
    summary="State the metadata of a test",
    response_model_exclude_none=True,
    responses=errors(404, 412, 422, 507),
)
def put_metadata(
    service: ServiceDep,
    test_id: TestId,
    body: TestMetadata,
    response: Response,
    if_match: Annotated[
        str | None, Header(max_length=200, description="ETag of the state that is replaced; another one is refused.")
    ] = None,
) -> TestMetadata:
    """Replace a test's metadata: lens, light, pattern, specimen, static steps and the like; a report shows them."""
    expected = None
    if if_match is not None and if_match.strip() != "*":
        expected = service.tests.metadata(test_id)
        if etag_of(expected) not in [tag.strip() for tag in if_match.split(",")]:
            raise StateError(
                f"The metadata of test {test_id} are not those that If-Match names.",
                code="metadata_changed",
                remedy="Read them again, then send the change.",
                etag=etag_of(expected),
            )
    document = body.document()
    service.tests.put_metadata(test_id, document, expected)
    return TestMetadata.model_validate(tagged(response, document))
