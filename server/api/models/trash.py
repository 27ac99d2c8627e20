"""The trash, and the acknowledgement of copies, as they travel."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from core.settings import Whole
from server.base.models import Listing, Reply, Request


class TrashEntry(Reply):
    """Something that was deleted and can be restored."""

    id: str = Field(description="Id in the trash.", examples=["x000001-3f09aa"])
    kind: Literal["test", "step", "analysis", "calibration", "noise", "unknown"] = Field(description="What it was.")
    name: str = Field("", description="As people called it.")
    test_id: str | None = Field(None, description="Its test, or itself.")
    n: int | None = Field(None, description="Number of a step.")
    analysis_id: str | None = Field(None, description="Id of an analysis.")
    calibration_id: str | None = Field(None, description="Id of a calibration.")
    noise_id: str | None = Field(None, description="Id of a noise measurement.")
    deleted_utc: str | None = Field(None, description="When it was deleted.")
    deleted_by: str | None = Field(None, description="Whose key it was; `local` where none is asked for.")
    why: str | None = Field(None, description="`asked for`; `retention` where an earlier version moved it by itself.")
    size_bytes: int | None = Field(None, description="Room that emptying frees.")


class TrashList(Listing):
    """The trash, oldest first."""

    trash: list[TrashEntry] = Field(description="What lies there.")


class ExportedRequest(Request):
    """What the copy of a test that lies elsewhere holds."""

    steps: Annotated[Whole, Field(ge=0, le=10000)] = Field(
        description="Number of complete steps in the copy.", examples=[120]
    )
    results: Annotated[Whole, Field(ge=0, le=10_000_000)] = Field(
        description="Number of result files (step_*.nc) in the copy, over all analyses.", examples=[240]
    )


class ExportedReply(Reply):
    """That the test was copied elsewhere."""

    utc: str = Field(description="When that was acknowledged.")
    by: str = Field(description="Whose key it was.")
    steps: int = Field(description="Number of complete steps.")
    results: int = Field(description="Number of result files.")
    sha256: str = Field(description="Of the checksums of all of them.")
