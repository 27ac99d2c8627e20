"""A load frame's record, aligned with the steps, as it travels."""

from __future__ import annotations

from pydantic import Field

from server.base.models import Reply


class StepAligned(Reply):
    """A step, and what the record says of it."""

    n: int = Field(description="Number of the step.")
    time_s: float | None = Field(None, description="Time of the record's clock that the step was taken at.")
    channels: dict[str, float] = Field(default_factory=dict, description="Channels that the step has now from it.")
    missing: str = Field("", description="Reason why it has none, or not all.")


class ChannelsImported(Reply):
    """What came of a record."""

    channels: dict[str, str] = Field(description="Unit of each channel of the record, by its name.")
    readings: int = Field(description="Readings over time in the record.")
    interval_s: float = Field(description="Median time between them.")
    max_gap_s: float = Field(description="Readings further apart than this were not joined.")
    n_steps: int = Field(0, description="Steps of the test.")
    n_aligned: int = Field(0, description="Steps that got channels from the record.")
    reasons: dict[str, int] = Field(
        default_factory=dict, description="Steps that have none, or not all, by the reason: their number."
    )
    steps: list[StepAligned] = Field(description="The first 100 steps, each with what the record says of it.")
    steps_next_cursor: str | None = Field(
        None, description="`cursor` of `GET /tests/{id}/steps?channels=true` for the further steps; null: that was all."
    )
