"""The trash, and the acknowledgement of copies, as they travel."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from stereorig.core.settings import Whole
from stereorig.server.base.models import Listing, Reply, Request
from stereorig.server.documents.made import TrashEntry


class TrashList(Listing):
    """The trash, oldest first."""

    trash: list[TrashEntry] = Field(description="Entries of the trash.")


class ExportedRequest(Request):
    """Contents of a test's copy elsewhere."""

    steps: Annotated[Whole, Field(ge=0, le=10000)] = Field(
        description="Number of complete steps in the copy.", examples=[120]
    )
    results: Annotated[Whole, Field(ge=0, le=10_000_000)] = Field(
        description="Number of result files (step_*.nc) in the copy, over all analyses.", examples=[240]
    )


class ExportedReply(Reply):
    """That the test was copied elsewhere."""

    utc: str = Field(description="Time of the acknowledgement.")
    by: str = Field(description="Whose key it was.")
    steps: int = Field(description="Number of complete steps.")
    results: int = Field(description="Number of result files.")
    sha256: str = Field(description="Checksum of the checksums of all of them.")
