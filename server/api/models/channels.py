"""A load frame's record, aligned with the steps, as it travels."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.api.models.live import LiveChannel
from stereorig.server.base.models import Reply
from stereorig.server.formats.load_frames.description import RecordRead


class StepAligned(Reply):
    """A step, and its channels from the record."""

    n: int = Field(description="Number of the step.")
    time_s: float | None = Field(None, description="Time of the record's clock that the step was taken at.")
    channels: dict[str, float] = Field(default_factory=dict, description="Channels that the step has now from it.")
    missing: str = Field("", description="Reason why it has none, or not all.")


class ChannelsImported(Reply):
    """Result of an import of a record."""

    channels: dict[str, str] = Field(description="Unit of each channel of the record, by its name, as the file has it.")
    read: RecordRead = Field(description="Columns and rows that were recognised, left out and doubted.")
    readings: int = Field(description="Readings over time in the record.")
    interval_s: float = Field(description="Median time between them.")
    max_gap_s: float = Field(description="Largest distance of readings that were joined.")
    n_steps: int = Field(0, description="Steps of the test.")
    n_aligned: int = Field(0, description="Steps that got channels from the record.")
    reasons: dict[str, int] = Field(
        default_factory=dict, description="Steps that have none, or not all, by the reason: their number."
    )
    steps: list[StepAligned] = Field(description="The first 100 steps, each with its channels from the record.")
    steps_next_cursor: str | None = Field(
        None, description="`cursor` of `GET /tests/{id}/steps?channels=true` for the further steps; null: that was all."
    )


class ChannelsPreview(Reply):
    """Expected result of an import of a record."""

    channels: dict[str, str] = Field(description="Unit of each channel of the record, by its name, as the file has it.")
    read: RecordRead = Field(description="Columns and rows that are recognised, left out, doubted and open.")
    refused: str = Field("", description="Reason why an import is refused so; empty: it is not.")
    n_steps: int = Field(0, description="Steps of the test; 0 if it is refused.")
    n_aligned: int = Field(0, description="Steps that get channels from the record.")
    reasons: dict[str, int] = Field(
        default_factory=dict, description="Steps that get none, or not all, by the reason: their number."
    )
    steps: list[StepAligned] = Field(description="The first 100 steps, each with the channels that it gets.")


class ChannelsRead(Reply):
    """The channels that the rig file names."""

    channels: dict[str, LiveChannel] = Field(description="Channels by name, each with its line and newest reading.")
