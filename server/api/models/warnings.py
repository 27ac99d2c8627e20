"""Warnings of results, as they travel."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stereorig.server.base.models import Reply


class AnalysisWarning(Reply):
    """A reason for which a result is not to be used as it is."""

    code: str = Field(
        description="Stable name: `epipolar_check_failed`, `low_coverage`, `cameras_off_zero`, `steps_failed` ...",
        examples=["epipolar_check_failed"],
    )
    level: Literal["failed", "warning"] = Field(
        description="`failed`: no number of it should be reported; `warning`: with care."
    )
    text: str = Field(description="The finding, with its figures.")
    remedy: str = Field(description="What to do.")
    steps: list[int] = Field(
        default_factory=list, description="Steps that it holds for, 100 at most; empty: all of it."
    )
    n_steps: int | None = Field(None, description="Number of the steps, if there are more than 100.")
