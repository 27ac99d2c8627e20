"""A live measurement as it travels."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from stereorig.drivers.acquisition.simultaneity import SKEW_SOURCES, SkewSource
from stereorig.server.api.models.jobs import JobProblem
from stereorig.server.base.models import Channels, Number, Reply, Request, Switch
from stereorig.server.results.gauges.request import Name, Variable


class LiveNumber(Reply):
    """A number with its standard uncertainty."""

    value: float = Field(description="The value.")
    u: float | None = Field(description="Standard uncertainty (k = 1); null if it is not known.")
    u_calibration: float | None = Field(description="The calibration's part of it; null: not known, and not included.")
    budget: dict[str, float] = Field(
        default_factory=dict,
        description="`u` by cause; the squares add up. `matching` holds the reference's noise too.",
    )
    units: str = Field(description="Unit; `1` of a number without one.")


class LiveGaugeReply(Reply):
    """A gauge in one frame."""

    kind: Literal["point", "extensometer", "area"] = Field(description="Kind of gauge.")
    valid: bool = Field(description="False if it has no valid values.")
    reason: str = Field(
        description="Why: the status of a point that it needs, `cut`, `occluded`, `silence`, a camera's or frame's "
        "error code; empty if it is valid."
    )
    values: dict[str, LiveNumber] = Field(description="By quantity; empty if it is not valid.")


class LiveValues(Reply):
    """The values of one frame."""

    number: int = Field(description="Number of the measured frame, from 1; 0 before the first.")
    valid: bool = Field(description="False if the newest frame, or its absence, leaves no valid values.")
    reason: str = Field(description="Reason; empty if they are valid.")
    time_s: float | None = Field(
        None, description="Beginning of camera 1's exposure on the host's monotonic clock, which channels refer to."
    )
    device_time_s: float | None = Field(None, description="The same on camera 1's own clock.")
    exposed_utc: str | None = Field(None, description="The same in UTC.")
    skew_ms: float | None = Field(None, description="Beginning of camera 2's exposure minus camera 1's.")
    skew_uncertainty_ms: float | None = Field(None, description="Largest error of the skew.")
    skew_source: SkewSource | None = Field(None, description=SKEW_SOURCES)
    how: Literal["followed", "step"] | None = Field(
        None, description="`followed` from the frames before, or measured as a `step` is, with all its checks."
    )
    points: int | None = Field(None, description="Points with values.")
    status: dict[str, int] | None = Field(None, description="Points by status.")
    arrived_s: float | None = Field(None, description="Arrival of the later frame, on the host's monotonic clock.")
    latency_ms: float | None = Field(None, description="From the arrival of the frames to these values.")
    gauges: dict[str, LiveGaugeReply] = Field(description="By name.")


class LiveAccount(Reply):
    """Each frame pair that came, by its fate: frames = measured + skipped + refused + waiting."""

    frames: int = Field(description="Pairs that the cameras delivered.")
    measured: int = Field(description="Measured: `followed` and `step` of them.")
    followed: int = Field(description="Measured from the frames before.")
    step: int = Field(description="Measured as a step is.")
    skipped: int = Field(description="A newer pair came before they were measured.")
    refused: int = Field(description="Not usable, by `refused_by`.")
    waiting: int = Field(description="Being measured, or next.")
    refused_by: dict[str, int] = Field(description="Refused pairs by code.")
    without_frame_by: dict[str, int] = Field(description="Waits for a pair that ended in an error, by its code.")
    latency_ms: dict[str, float] | None = Field(
        description="`p50` and `p99` of the last 500 frames, from arrival to values; null before the first."
    )
    rate_hz: float | None = Field(description="Measured frames a second, over the last 500.")


class LiveLine(Reply):
    """The line that a channel is read from."""

    state: Literal["unreachable", "silent", "reading"] = Field(
        description="`unreachable`: it is opened again and again; `silent`: open, and no value comes."
    )
    values: int = Field(description="Lines that had a value.")
    unreadable: int = Field(description="Lines that had none.")
    losses: int = Field(description="Times that the open line was lost.")
    reason: str = Field(description="Reason why it is not `reading`; empty if it is.")


class LiveChannel(Reply):
    """A channel whose readings were sent, or are read from a line."""

    unit: str = Field("", description="Its unit, if the rig file has one.")
    line: LiveLine | None = Field(None, description="Line of a channel that the rig file names; null for a posted one.")
    readings: int = Field(0, description="Readings that are kept.")
    last_time_s: float | None = Field(
        None, description="Time of the last one, by the channel's clock; for a line the time of its arrival."
    )
    last_value: float | None = Field(None, description="Its value.")
    fault: str = Field(
        "", description="Why its readings cannot be believed: stuck, or another channel's; mostly empty."
    )
    offset_s: float = Field(0.0, description="Added to the channel's times; 0 before it was aligned.")
    offset_u_s: float | None = Field(None, description="Standard uncertainty of that; null before it was aligned.")


class LiveReply(Reply):
    """A live measurement."""

    test_id: str = Field(description="The test.")
    state: Literal["starting", "running", "ended", "failed"] = Field(
        description="`starting`: the reference is measured."
    )
    since_utc: str = Field(description="When it was begun.")
    settings: dict[str, Any] = Field(description="As they were asked for, with the region.")
    problem: JobProblem | None = Field(None, description="Why it failed.")
    reference_points: int | None = Field(None, description="Points that the reference has; null before it is measured.")
    values: LiveValues = Field(description="The newest values.")
    account: LiveAccount = Field(description="Counters of the frames by their fate.")
    channels: dict[str, LiveChannel] = Field(description="Channels by name.")
    tcp_port: int | None = Field(None, description="Port of the line protocol; null while it is off.")


class LiveMoment(Reply):
    """One frame of the last minutes."""

    number: int = Field(description="Number of the frame.")
    time_s: float = Field(description="Its exposure on the host's monotonic clock.")
    values: dict[str, dict[str, float]] = Field(description="By gauge and quantity.")
    channels: dict[str, float] = Field(
        description="Channels at the exposure, on the line between the readings about it; those that are not known yet "
        "are left out."
    )


class LiveHistory(Reply):
    """The last frames, oldest first."""

    frames: list[LiveMoment] = Field(description="The frames.")


class LiveField(Reply):
    """The newest displacements of all points."""

    number: int = Field(description="Number of the frame.")
    x_px: list[float] = Field(description="Columns of the points in camera 1's reference image.")
    y_px: list[float] = Field(description="Their rows.")
    u_mm: list[list[float | None]] = Field(description="By row and column; null without a value.")
    v_mm: list[list[float | None]] = Field(description="Likewise.")
    w_mm: list[list[float | None]] = Field(description="Likewise.")


class LiveReading(Request):
    """Readings of channels at one time."""

    time_s: Number | None = Field(
        None, description="By the channel's own clock; the host's monotonic clock at arrival if left out."
    )
    channels: Channels = Field(description="Values by name.", examples=[{"force_n": 812.5}])


class LiveReadings(Request):
    """Readings of channels for a live measurement."""

    readings: list[LiveReading] = Field(
        description="In the order of their times.", min_length=1, max_length=5000, fail_fast=True
    )


class LiveReadingsReply(Reply):
    """Number of readings that were taken."""

    taken: int = Field(description="Values that were taken.")


class AlignRequest(Request):
    """A channel and a gauge that both saw a knock, or the beginning or end of a ramp."""

    channel: Annotated[str, StringConstraints(min_length=1, max_length=100)] = Field(
        description="Name of the channel.", examples=["force_n"]
    )
    gauge: Name = Field(description="Name of the gauge.", examples=["e1"])
    quantity: Variable = Field("strain", description="Quantity of it, `eyy` of an area or `w_mm` of a point.")
    within_s: Annotated[Number, Field(gt=0.0, le=60.0)] = Field(
        2.0, description="Largest offset that is looked for, either way."
    )
    keep: Switch = Field(True, description="Add the offset to the channel's times from now on.")


class AlignReply(Reply):
    """Offset of a channel's clock."""

    offset_s: float = Field(description="Added to the channel's times, they are on the host's monotonic clock.")
    u_s: float = Field(description="Its standard uncertainty (k = 1).")
    gain: float = Field(description="The gauge is bias + gain channel.")
    bias: float = Field(description="See `gain`.")
    correlation: float = Field(description="Of gauge and channel at that offset.")
    readings: int = Field(description="Pairs that were compared.")
