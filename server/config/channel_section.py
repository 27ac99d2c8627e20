"""[[channels]] of the rig file: channels that are read during captures, and stored with each step."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Argument = Annotated[str, Field(pattern=r"^[^\x00]{1,1000}$")]
#: units of the load, of those that `stereorig.server.formats.channel_units` can turn into newtons
FORCES = ("N", "kN", "MN", "mN", "cN", "daN", "lbf", "klbf", "kip", "kgf", "gf", "tf")


class ChannelSection(BaseModel):
    """[[channels]]: a channel that is read all the time; each step has its value at the exposure."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,100}$")] = Field(description="Name of the channel.")
    url: Annotated[str, Field(pattern=r"^(tcp://[^\s/]+:[0-9]{1,5}|/dev/\S+|rfc2217://\S+)$")] | None = Field(
        None, description="`tcp://host:port`, or a serial port: `/dev/ttyUSB0`, `rfc2217://host:port`."
    )
    exec: Annotated[tuple[Argument, ...], Field(min_length=1, max_length=100)] | None = Field(
        None,
        description="In place of `url`: a program and its arguments that writes a line for each value. It runs without "
        "a shell as the service's user, is started again when it ends, and ended with the service.",
    )
    daq: Annotated[str, Field(pattern=r"^[A-Za-z0-9_/:.-]{1,100}$")] | None = Field(
        None,
        description="In place of `url`: an analog input of National Instruments, `Dev1/ai0`, read in volts `rate_hz` "
        "times a second; needs the extra `nidaqmx`.",
    )
    baudrate: int = Field(9600, ge=50, le=10_000_000, description="Baud rate of a serial port.")
    pattern: Annotated[str, Field(min_length=1, max_length=200)] | None = Field(
        None, description="Regular expression whose first group is the number; left out: `column` counts."
    )
    column: int = Field(
        1,
        ge=1,
        le=100,
        description="Place of the value in a line, whose parts have commas, semicolons or blanks between.",
    )
    decimal: Literal[".", ","] | None = Field(
        None,
        description="Decimal sign; left out: a point, and a number with a comma between digits is refused as unsure.",
    )
    thousands: Literal[",", ".", " ", "'"] | None = Field(None, description="Sign that groups thousands.")
    scale: Annotated[float, Field(allow_inf_nan=False)] = Field(
        1.0, description="The value is the number times this, plus `offset`: 4.4482216 for lbf in N."
    )
    offset: Annotated[float, Field(allow_inf_nan=False)] = Field(0.0, description="Added to the scaled number.")
    frame: Annotated[str, Field(pattern=r"^[5-8][NEOMS](1|1\.5|2)$")] = Field(
        "8N1", description="Bits, parity and stop bits of a serial port; balances often have `7E1`."
    )
    line_end: Annotated[str, Field(pattern=r"^[\x21-\x7e]{0,8}$")] = Field(
        "", description="Further characters that end a line, after CR and LF: `$`, or a prompt such as `:`."
    )
    query_end: Annotated[str, Field(pattern=r"^[\r\n\x21-\x7e]{0,8}$")] = Field("\n", description="Sent after `query`.")
    query: Annotated[str, Field(pattern=r"^[\x20-\x7e]{1,100}$")] | None = Field(
        None, description="Sent as a line each time a value is wanted; left out: the device sends by itself."
    )
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = Field(
        10.0, description="How often `query` is sent, or a `daq` is read."
    )
    unit: Annotated[str, Field(max_length=20)] = Field("", description="Unit of the value, as it is shown.")
    load: bool = Field(False, description="The value is the load of each step; its unit must be one of force.")
    latency_ms: Annotated[float, Field(ge=0.0, le=60_000.0)] = Field(
        0.0, description="Time from the measurement in the instrument to the line; values are dated back by it."
    )
    silence_s: Annotated[float, Field(gt=0.0, le=3600.0)] = Field(
        1.0, description="A channel without a value for this long is shown as silent."
    )

    @model_validator(mode="after")
    def _has_a_source(self) -> Self:
        given = [name for name in ("url", "exec", "daq") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a channel has one of url, exec and daq; {self.name} has {' and '.join(given) or 'none'}")
        if self.load and self.unit not in FORCES:
            raise ValueError(f"the load is in one of {', '.join(FORCES)}; {self.name} is in {self.unit or 'no unit'}")
        return self

    @model_validator(mode="after")
    def _has_a_group(self) -> Self:
        if self.pattern is not None:
            try:
                groups = re.compile(self.pattern).groups
            except re.error as error:
                raise ValueError(f"pattern is no regular expression: {error}") from error
            if groups < 1:
                raise ValueError("pattern needs a group, which is the number")
        return self
