"""The rig file: one closed model, with a description on every field.

The same TOML file serves ``stereorig serve`` and, as far as the nominal camera data go, ``stereorig calibrate``. A
key that is not known is an error, not a silent nothing; errors are one line that names the field.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from stereorig.core.errors import FileFormatError, StageError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.server.config.camera_metadata import Above, CameraMetadata, LensMetadata, Text
from stereorig.server.config.channel_section import ChannelSection
from stereorig.server.wording import problems_in

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Whole = Annotated[int, Field(ge=0, le=65535)]

# Skew may shift one image against the other by this much, a third of the standard deviation of correlation
SKEW_PX = 0.01
DEFAULT_SKEW_MS = 5.0


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RigSection(_Closed):
    """[rig]: the whole."""

    name: str = Field(description="Name of the rig, shown to users and kept with every result.", max_length=200)
    kind: Literal["simulated", "real"] = Field(description="`simulated` starts a simulated world with its controllers.")
    trigger: Literal["software", "hardware", "free", "action"] = Field(
        "software",
        description="Start of both cameras' exposures: a call, pulses on their lines, nothing, or one action command "
        "to both (GigE Vision). If one camera drives the other by its strobe_line, start of the driving one's.",
    )
    action_lead_ms: Annotated[float, Field(gt=0.0, le=10000.0)] | None = Field(
        None, description="Time from an action command to the exposures, by the cameras' PTP clock; left out: at once."
    )
    action_broadcast: bool = Field(
        True, description="One packet for both cameras, if one interface reaches both; else one for each."
    )
    frame_rate_hz: Positive | None = Field(
        None, description="Rate of free-running cameras, or of the pulses of a hardware trigger if they are regular."
    )
    pairing: Literal["auto", "time", "frame"] = Field(
        "auto",
        description="Pairing of the frames of two streams: by time, or by frame number aligned by time. `auto`: "
        "by frame number under a hardware trigger with a known rate, else by time.",
    )
    max_skew_ms: Positive | None = Field(
        None,
        description="A pair is rejected if its exposures began at times that differ by more. "
        "Left out: 0.01 px at image_speed_px_s.",
    )
    image_speed_px_s: Positive | None = Field(
        None,
        description="Maximum speed of the image while a pair is taken; gives the skew limit if max_skew_ms is left "
        "out. With neither, the limit is 5 ms, and 0.01 px at the measured speed where several frames are averaged.",
    )
    capture_timeout_s: Annotated[float, Field(gt=0.0, le=3600.0)] = Field(
        10.0, description="Maximum wait of a capture for a pulse of a hardware trigger that has no frame_rate_hz."
    )
    auto_reconnect: bool = Field(True, description="Connect a camera again by itself when it comes back after a loss.")
    description: str = Field("", description="Free text.", max_length=2000)
    lighting: Text | None = Field(None, description="Lamps and their arrangement; kept with every step, for reports.")

    @model_validator(mode="after")
    def _rate_known(self) -> Self:
        if self.trigger == "free" and self.frame_rate_hz is None:
            raise ValueError("frame_rate_hz is needed with trigger = 'free'")
        if self.pairing == "frame" and (self.trigger != "hardware" or self.frame_rate_hz is None):
            raise ValueError("pairing = 'frame' needs trigger = 'hardware' and frame_rate_hz")
        return self

    @property
    def skew_bound_ms(self) -> float:
        """Return the maximum skew of a pair that is measured."""
        if self.max_skew_ms is not None:
            return self.max_skew_ms
        return DEFAULT_SKEW_MS if self.image_speed_px_s is None else 1000.0 * SKEW_PX / self.image_speed_px_s


class CameraSection(_Closed):
    """[cam1], [cam2]: nominal data, driver and stage axis of one camera."""

    image_size_px: tuple[Annotated[int, Field(ge=16, le=32767)], Annotated[int, Field(ge=16, le=32767)]] = Field(
        description="Width and height of the image."
    )
    phd_px: Positive = Field(description="Nominal pinhole distance in column pitches (focal length over pixel pitch).")
    standoff_mm: Positive | None = Field(
        None, description="Nominal distance from the pinhole to the target; only free poses do without."
    )
    angle_deg: Annotated[float, Field(gt=-90.0, lt=90.0)] | None = Field(
        None, description="Nominal gamma of Eq. (1); only free poses do without."
    )
    aspect: Positive = Field(1.0, description="Rows' scale over columns' scale (lambda).")
    bit_depth: Literal[8, 10, 12, 14, 16] = Field(8, description="Significant bits per pixel.")
    driver: Literal["sim", "aravis", "pylon", "v4l2"] = Field("sim", description="Frame grabber driver.")
    device: str | None = Field(
        None,
        description="The driver's name of the device, as `stereorig devices` lists it; the simulated rig needs none.",
    )
    serial: str | None = Field(
        None, description="Serial number the camera must have; left out: any, checked after a loss."
    )
    stage_axis: int = Field(1, ge=1, le=31, description="Stage axis that moves this camera along its optical axis.")
    stage_sign: Literal[-1, 1] = Field(
        1, description="dZ = sign * (position - zero), dZ positive away from the target."
    )
    exposure_ms: Positive | None = Field(None, description="Exposure set when the camera is opened.")
    gain_db: Finite | None = Field(None, description="Gain set when the camera is opened.")
    region_px: tuple[Whole, Whole, Whole, Whole] | None = Field(
        None, description="x0, y0, width, height read out of the sensor; width and height as in image_size_px."
    )
    pixel_format: str | None = Field(
        None, description="The device's own name of a format (Mono12Packed, Y12); left out: the plainest of bit_depth."
    )
    features: dict[str, bool | int | float | str] = Field(
        default_factory=dict,
        description="Other settings by the device's own name (GenICam feature, V4L2 control), set in this order.",
    )
    buffers: int = Field(16, ge=2, le=1000, description="Frames that may be under way between camera and reader.")
    packet_size_bytes: int | None = Field(
        None, ge=576, le=16000, description="GigE Vision packets; left out: the maximum that passes."
    )
    ptp: bool = Field(False, description="Switch the camera's IEEE 1588 clock on.")
    trigger_source: str = Field("Line1", description="GenICam line of the hardware trigger.")
    trigger_edge: Literal["rising", "falling"] = Field("rising", description="Edge that starts the exposure.")
    strobe_line: str | None = Field(
        None,
        description="GenICam output by which this camera drives the other's trigger_source: set to `ExposureActive`.",
    )
    trigger_features: dict[Literal["free", "software", "hardware", "action"], dict[str, bool | int | float | str]] = (
        Field(default_factory=dict, description="Controls or features that bring the device into a trigger mode.")
    )
    maker: Text | None = Field(None, description="Maker of the camera; kept with every step, for reports.")
    sensor: Text | None = Field(None, description="The sensor; for reports.")
    pixel_um: Above | None = Field(None, description="Width of a pixel on the sensor; for reports.")
    lens: LensMetadata | None = Field(None, description="The lens, as printed on it; for reports.")

    @model_validator(mode="after")
    def _device_named(self) -> Self:
        if self.driver != "sim" and self.device is None:
            raise ValueError(f"device is needed with driver = {self.driver!r}; `stereorig devices` lists what there is")
        if self.region_px is not None and self.region_px[2:] != self.image_size_px:
            raise ValueError(f"region_px is {self.region_px[2:]} px large, image_size_px is {self.image_size_px}")
        return self

    def metadata(self) -> CameraMetadata:
        """Return the file's metadata of camera and lens, for reports."""
        return CameraMetadata(maker=self.maker, model=None, sensor=self.sensor, pixel_um=self.pixel_um, lens=self.lens)


# of an XPS' configuration; no character that its language uses
Positioner = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,60}\.[A-Za-z0-9_-]{1,60}$")]
_ZABER_PLACE = r"[1-9][0-9]?\.[1-9]"
_POSITIONER = (
    "XPS: name of the axis, the one positioner of its group; `Group1.Pos` for axis 1 if left out. "
    "Zaber: device and axis; `1.1` for axis 1 if left out."
)
_MM_PER_STEP = (
    "Standa: travel of a full motor step, which the controller does not know. Zaber: of a microstep. "
    "Kinesis: of an encoder count or microstep."
)


class StageAxisSection(_Closed):
    """[stage.axes.N]: settings of axis N that differ from [stage]."""

    soft_limits_mm: tuple[Finite, Finite] | None = Field(None, description="Lowest and highest position.")
    velocity_mm_s: Positive | None = Field(None, description="Velocity set when the stage is opened.")
    acceleration_mm_s2: Positive | None = Field(None, description="Acceleration set when the stage is opened.")
    backlash_mm: Annotated[float, Field(ge=0.0)] | None = Field(None, description="Travel that every move ends with.")
    approach_from: Literal["below", "above"] | None = Field(
        None, description="Side that positions are arrived at from."
    )
    settle_ms: Annotated[float, Field(ge=0.0, le=60000.0)] | None = Field(None, description="Wait after motion.")
    tolerance_mm: Positive | None = Field(None, description="A position read back further away is a fault.")
    resolution_mm: Positive | None = Field(None, description="Least count of the positions read back.")
    zero_mm: Finite | None = Field(None, description="Stage position of dZ = 0.")
    assume_homed: bool | None = Field(
        None, description="Trust an ESP301's position although this service did not home it."
    )
    home_mode: Annotated[int, Field(ge=0, le=6)] | None = Field(None, description="ESP301: parameter of OR.")
    positioner: Positioner | None = Field(None, description=_POSITIONER)
    mm_per_step: Positive | None = Field(None, description=_MM_PER_STEP)

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        if self.soft_limits_mm is not None:
            _check_order(self.soft_limits_mm)
        return self


def _check_order(limits_mm: tuple[float, float]) -> None:
    if not limits_mm[0] < limits_mm[1]:
        raise ValueError(f"soft_limits_mm must be [low, high] with low < high, got {list(limits_mm)}")


StageDriver = Literal["esp301", "smc100", "conex-cc", "kinesis", "pi", "standa", "xps", "zaber"]
AxisNumber = Annotated[int, Field(ge=1, le=31)]


class ControllerSection(_Closed):
    """[[stage.controllers]]: one of several controllers, each with a line of its own."""

    url: str = Field(description="pyserial URL or port; `sim` starts a simulated controller.", min_length=1)
    axes: tuple[AxisNumber, ...] = Field(
        description="Axes of the rig that it moves, as stage_axis of the cameras names them.", min_length=1
    )
    own_axes: tuple[AxisNumber, ...] | None = Field(
        None, description="The controller's own numbers of these axes, in the same order; 1, 2, ... if left out."
    )
    driver: StageDriver | None = Field(None, description="Protocol of the controller; as in [stage] if left out.")
    baudrate: int | None = Field(None, ge=300, le=4_000_000, description="Baud rate; as in [stage] if left out.")
    flow_control: Literal["hardware", "software", "none"] | None = Field(
        None, description="Flow control of the line; as in [stage] if left out."
    )

    @property
    def numbers(self) -> dict[int, int]:
        """Return the controller's own number of each of the rig's axes."""
        own = range(1, len(self.axes) + 1) if self.own_axes is None else self.own_axes
        return dict(zip(self.axes, own, strict=True))

    @model_validator(mode="after")
    def _numbered_once(self) -> Self:
        own = self.axes if self.own_axes is None else self.own_axes
        if len(own) != len(self.axes) or len(set(own)) != len(own) or len(set(self.axes)) != len(self.axes):
            raise ValueError(f"axes {list(self.axes)} and own_axes {list(own)} must be as many, each named once")
        return self


class StageSection(_Closed):
    """[stage]: the motion controller and its axes; left out if nothing moves."""

    driver: StageDriver = Field(description="Protocol of the controller.")
    url: str | None = Field(
        None,
        description="pyserial URL or port; `sim` starts a simulated controller. Left out with `controllers`.",
        min_length=1,
    )
    controllers: list[ControllerSection] = Field(
        default_factory=list,
        description="Several controllers, each with its own line and axes, in place of `url`.",
        max_length=31,
    )
    baudrate: int | None = Field(
        None, ge=300, le=4_000_000, description="Baud rate, if it is not the controller's usual one."
    )
    flow_control: Literal["hardware", "software", "none"] | None = Field(
        None, description="Flow control of the line, if it is not the controller's usual one."
    )
    reply_timeout_ms: Annotated[float, Field(ge=50.0, le=10000.0)] = Field(
        500.0, description="Maximum wait for a reply; longer over a slow network."
    )
    soft_limits_mm: tuple[Finite, Finite] = Field(description="Lowest and highest position; tightens the controller's.")
    velocity_mm_s: Positive | None = Field(None, description="Velocity set when the stage is opened.")
    acceleration_mm_s2: Positive | None = Field(None, description="Acceleration set when the stage is opened.")
    backlash_mm: Annotated[float, Field(ge=0.0)] = Field(0.0, description="Every move arrives with this much travel.")
    approach_from: Literal["below", "above"] = Field(
        "below", description="Side that every position is arrived at from."
    )
    settle_ms: Annotated[float, Field(ge=0.0, le=60000.0)] = Field(0.0, description="Wait after the end of motion.")
    tolerance_mm: Positive = Field(0.002, description="A position read back further from its target is a fault.")
    resolution_mm: Positive | None = Field(
        None, description="Least count of the positions read back; over the root of 12 in a calibration's covariance."
    )
    zero_mm: Finite = Field(0.0, description="Stage position of dZ = 0, where the cameras measure.")
    assume_homed: bool = Field(False, description="Trust an ESP301's position although this service did not home it.")
    home_mode: Annotated[int, Field(ge=0, le=6)] | None = Field(None, description="ESP301: parameter of OR.")
    positioner: Positioner | None = Field(None, description=_POSITIONER)
    mm_per_step: Positive | None = Field(None, description=_MM_PER_STEP)
    home_at_start: bool | None = Field(
        None,
        description="Home when the service starts; only simulated stages do if left out. A controller that is found "
        "later is never moved unasked.",
    )
    axes: dict[Annotated[int, Field(ge=1, le=31)], StageAxisSection] = Field(
        default_factory=dict, description="Settings that differ from axis to axis, by axis number."
    )

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        _check_order(self.soft_limits_mm)
        return self

    @model_validator(mode="after")
    def _lines_known(self) -> Self:
        if (self.url is None) != bool(self.controllers):
            raise ValueError("give either url or [[stage.controllers]]")
        named = [axis for controller in self.controllers for axis in controller.axes]
        twice = next((axis for axis in named if named.count(axis) > 1), None)
        if twice is not None:
            raise ValueError(f"two of stage.controllers move axis {twice}")
        lines = [controller.url for controller in self.controllers if controller.url != "sim"]
        shared = next((url for url in lines if lines.count(url) > 1), None)
        if shared is not None:
            raise ValueError(f"two of stage.controllers have the url {shared}; a chain on one line is one controller")
        return self

    def lines(self, axes: tuple[int, ...]) -> list[ControllerSection]:
        """Return each controller with every key filled in; the one of the plain form moves all of the rig's axes."""
        found = self.controllers
        if self.url is not None:
            found = [ControllerSection(url=self.url, axes=axes, own_axes=axes)]
        usual = {name: getattr(self, name) for name in ("driver", "baudrate", "flow_control")}
        return [
            one.model_copy(update={**usual, **one.model_dump(include=set(usual), exclude_none=True)}) for one in found
        ]

    def of_axis(self, axis: int) -> StageSection:
        """Return the section as it holds for one axis."""
        own = self.axes.get(axis)
        return self if own is None else self.model_copy(update=own.model_dump(exclude_none=True))


Lines = Annotated[int, Field(ge=3, le=201)]
LineNumbers = Annotated[list[Annotated[int, Field(ge=1, le=201)]], Field(max_length=200)]
Points = Annotated[int, Field(ge=3, le=200)]
_LINE_GRID_FIELDS = ("lines", "line_width_mm")
_CHARUCO_FIELDS = ("marker_mm", "dictionary")


class TargetSection(_Closed):
    """[target]: the calibration target, a line grid or a board of squares or dots."""

    kind: Literal["line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric"] = Field(
        "line_grid", description="Kind of target."
    )
    pitch_mm: Positive = Field(
        description="Distance of neighbouring lines or dots, side of a square; of an asymmetric grid, distance of "
        "neighbouring rows: dots of one row are two pitches from each other."
    )
    lines: tuple[Lines, Lines] | None = Field(
        None, description="Line grid: number of lines crossed when walking along X_sys and along Y_sys."
    )
    line_width_mm: Positive | None = Field(None, description="Line grid: width of a line.")
    node_tolerance_mm: Annotated[float, Field(ge=0.0)] = Field(
        0.0, description="Maker's tolerance of the positions of lines, corners or dots."
    )
    dark_lines: bool = Field(True, description="Line grid: dark lines on a bright ground, or the other way round.")
    missing_lines: tuple[LineNumbers, LineNumbers] | None = Field(
        None,
        description="Line grid: numbers, from 1, of the lines that it lacks, of those crossed along X_sys (columns) "
        "and of those crossed along Y_sys (rows): [[4], []]; none if left out.",
    )
    size: tuple[Points, Points] | None = Field(None, description="Boards: inner corners or dots a row, then a column.")
    marker_mm: Positive | None = Field(None, description="ChArUco: side of a marker.")
    dictionary: Annotated[str, Field(pattern=r"^DICT_[A-Z0-9_]+$", max_length=40)] | None = Field(
        None, description="ChArUco: OpenCV's name of the markers' dictionary; DICT_5X5_100 if left out."
    )

    pitch_scale_sigma: Annotated[float, Field(ge=0.0, le=0.05)] | None = Field(
        None,
        description="Relative standard deviation of the whole target's scale; the tolerance over its size if left out.",
    )
    flatness_mm: Annotated[float, Field(ge=0.0)] | None = Field(
        None, description="Maker's bound on the points' error out of the plane; node_tolerance_mm if left out."
    )
    dot_diameter_mm: Positive | None = Field(None, description="Dots: diameter; measured in the images if left out.")

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> Self:
        grid = self.kind == "line_grid"
        needed = _LINE_GRID_FIELDS if grid else ("size", "marker_mm") if self.kind == "charuco" else ("size",)
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise ValueError(f"a target of kind {self.kind!r} needs {', '.join(missing)}")
        own = (*_LINE_GRID_FIELDS, "dark_lines", "missing_lines")
        strange: tuple[str, ...] = ("size", *_CHARUCO_FIELDS) if grid else own
        if not grid and self.kind != "charuco":
            strange = (*strange, *_CHARUCO_FIELDS)
        if self.kind not in ("circles", "circles_asymmetric"):
            strange = (*strange, "dot_diameter_mm")
        found = [name for name in strange if name in self.model_fields_set and getattr(self, name) is not None]
        if found:
            raise ValueError(f"a target of kind {self.kind!r} has no {', '.join(found)}")
        counts = self.lines or (0, 0)
        for numbers, count in zip(self.missing_lines or (), counts, strict=False):
            if any(k > count for k in numbers) or count - len(set(numbers)) < 5:
                raise ValueError(f"missing_lines {numbers} must be among the {count} lines and leave five of them")
        if self.marker_mm is not None and not self.marker_mm < self.pitch_mm:
            raise ValueError(f"marker_mm {self.marker_mm:g} must be smaller than pitch_mm {self.pitch_mm:g}")
        return self

    def plain(self) -> dict[str, Any]:
        """Return the fields of its kind, as JSON; of a line grid without the kind, as files have had them ever."""
        fields = self.model_dump(mode="json", exclude_none=True)
        for name in ("kind",) if self.kind == "line_grid" else ("dark_lines",):
            fields.pop(name)
        return fields


class CalibrationSection(_Closed):
    """[calibration]: the usual plan; a request can give another one."""

    moves: Literal["cameras", "both_cameras", "target", "free"] = Field(
        "cameras",
        description="Part that the stage moves by dZ: each camera along its own axis, both cameras on one axis, the "
        "target on one axis; or nothing: the target is shown in free poses, see `stereorig guide`.",
    )
    lens: Literal[
        "auto",
        "paper",
        "opencv5",
        "opencv8",
        "opencv5_prism",
        "opencv5_tilted",
        "opencv5_prism_tilted",
        "opencv12",
        "opencv14",
    ] = Field("auto", description="Lens model; `auto` takes the simplest whose residuals hold no structure.")
    positions_mm: tuple[Finite, ...] = Field(
        (), description="dZ of the fitted positions; needed where something moves by dZ.", max_length=100
    )
    held_out_mm: tuple[Finite, ...] = Field(
        (), description="dZ of the positions kept for the check; none: left out in turn.", max_length=100
    )
    frames: int = Field(4, ge=1, le=256, description="Frames averaged at each position.")
    localiser: Literal["profile", "paper"] = Field("profile", description="Grid line localiser.")
    axis_tilt_sigma_rad: Annotated[float, Field(ge=0.0, le=0.1)] = Field(
        1e-3, description="Prior on the angle between stage axis and optical axis; carried into the covariance."
    )
    stage_scale_sigma: Annotated[float, Field(ge=0.0, le=0.1)] = Field(
        1e-4, description="Prior on the relative error of the stage's scale; 0: exact. Left out, it is assumed."
    )
    stage_step_sigma_mm: Annotated[float, Field(ge=0.0, le=1.0)] | None = Field(
        None, description="Prior on the error of each position read back; left out: by the stage's resolution_mm."
    )
    aspect_sigma: Annotated[float, Field(ge=0.0, le=0.1)] | None = Field(
        None,
        description="Prior on the aspect ratio; left out: 1e-4 where only a stage moves and aspect is not 1, none in "
        "free poses. 0: exact.",
    )

    @model_validator(mode="after")
    def _positions_given(self) -> Self:
        if self.moves != "free" and not self.positions_mm:
            raise ValueError(f"positions_mm is needed with moves = {self.moves!r}")
        return self


class ServiceSection(_Closed):
    """[service]: limits of the service itself."""

    compute_queue: int = Field(16, ge=1, le=1000, description="Computations that may wait; beyond it 503.")
    kernel_threads: int | None = Field(
        None, ge=1, le=256, description="Kernel threads of the worker; all cores if left out."
    )
    free_reserve_mib: Annotated[float, Field(ge=0.0)] = Field(
        256.0,
        description="Room that is kept free on the data folder's disk: below it no step is taken and no job begun.",
    )
    live_views: int = Field(8, ge=1, le=100, description="Live views that may be open at once; beyond it 503.")
    connections: int = Field(
        1000, ge=10, le=20000, description="Connections at once; beyond it idle ones end, then live views."
    )
    event_streams: int = Field(
        200, ge=1, le=2000, description="Streams of server-sent events that may be open at once; beyond it 503."
    )
    require_key: bool = Field(
        False, description="Ask for a key on loopback too; on other addresses one is always asked for."
    )
    allowed_hosts: tuple[str, ...] = Field(
        (),
        description="Names under which clients may address the service, other than loopback and its own address; and "
        "whole origins, such as `https://board.example:3000`, of other pages that may ask it.",
        max_length=100,
    )
    requests_per_s: Positive = Field(
        500.0, description="Lasting rate of one address' requests; ten times as many at once."
    )


class LiveSection(_Closed):
    """[live]: values of a live measurement as lines over TCP, for test machines."""

    tcp_port: int | None = Field(
        None, ge=0, le=65535, description="Port of the line protocol; 0: any that is free; left out: it is off."
    )
    tcp_host: str = Field(
        "127.0.0.1",
        description="Address that it listens at. Without tcp_token every program that reaches it reads the values.",
        min_length=1,
        max_length=253,
    )
    tcp_token: Annotated[str, Field(pattern=r"^[\x21-\x7e]{8,200}$")] | None = Field(
        None, description="Word that a client sends first, `SYST:PASS <word>`; needed on another address than loopback."
    )

    @model_validator(mode="after")
    def _closed_to_others(self) -> Self:
        loopback = self.tcp_host in ("127.0.0.1", "localhost", "::1")
        if self.tcp_port is not None and not loopback and self.tcp_token is None:
            raise ValueError("tcp_token is needed where tcp_host is not loopback")
        return self


class ComputeSection(_Closed):
    """[compute]: where analyses are computed."""

    scheduler: Annotated[str, Field(pattern=r"^tcp://[^\s/]+:[0-9]+$")] | None = Field(
        None,
        description="Address of a Dask scheduler, tcp://host:8786; left out: one worker process of the service's own.",
    )
    images: Literal["path", "scatter"] = Field(
        "path",
        description="Way a cluster's workers get images: by path, if they see the data folder under the same name, "
        "or sent with each step.",
    )
    tasks_at_once: int | None = Field(
        None,
        ge=1,
        le=4096,
        description="Tasks that the cluster gets at once, if it adds workers while tasks wait: as many as it may "
        "grow to. Left out: as many as it has workers.",
    )
    threads_per_worker: int = Field(
        1, ge=1, le=256, description="Kernel threads of each of the cluster's workers, or of each of `processes`."
    )
    processes: int = Field(
        1,
        ge=1,
        le=256,
        description="Worker processes of the service's own that measure an analysis' steps side by side, where no "
        "scheduler is named; each holds the reference and a step in memory. 1: the one process with `kernel_threads` "
        "that everything else is computed in.",
    )


class RigConfig(_Closed):
    """A rig file."""

    rig: RigSection
    cam1: CameraSection
    cam2: CameraSection
    stage: StageSection | None = None
    target: TargetSection
    calibration: CalibrationSection
    service: ServiceSection = ServiceSection()
    compute: ComputeSection = ComputeSection()
    live: LiveSection = LiveSection()
    channels: list[ChannelSection] = Field(default_factory=list, description="Channels that are read.", max_length=50)
    sim: dict[str, Any] | None = Field(None, description="The simulated world's truth; its own part reads it.")

    @model_validator(mode="before")
    @classmethod
    def _channels_by_their_earlier_name(cls, config: Any) -> Any:
        live = config.get("live") if isinstance(config, dict) else None
        if not isinstance(live, dict) or not isinstance(live.get("channels"), list):
            return config
        rest = {name: value for name, value in live.items() if name != "channels"}
        return {**config, "live": rest, "channels": [*config.get("channels", ()), *live["channels"]]}

    @model_validator(mode="after")
    def _channels_named_once(self) -> Self:
        names = [channel.name for channel in self.channels]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two channels have the name {twice}")
        if sum(channel.load for channel in self.channels) > 1:
            raise ValueError("two channels are the load")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.rig.kind == "simulated":
            if self.sim is None:
                raise ValueError("a simulated rig needs a [sim] table")
            if self.cam1.driver != "sim" or self.cam2.driver != "sim":
                raise ValueError("a simulated rig needs driver = 'sim' for both cameras")
            if self.rig.trigger == "hardware":
                raise ValueError("a simulated rig has no pulses: rig.trigger is 'software' or 'free'")
        elif "sim" in (self.cam1.driver, self.cam2.driver):
            raise ValueError("driver = 'sim' needs rig.kind = 'simulated' and a [sim] table")
        return self

    @model_validator(mode="after")
    def _one_drives(self) -> Self:
        drivers = {self.cam1.driver, self.cam2.driver}
        driving = [name for name, section in (("cam1", self.cam1), ("cam2", self.cam2)) if section.strobe_line]
        if driving and drivers & {"sim", "v4l2"}:
            raise ValueError(f"{driving[0]}.strobe_line needs GenICam cameras: driver = 'aravis'")
        if len(driving) > 1:
            raise ValueError("cam1 and cam2 both have a strobe_line: only one camera can drive the other")
        if self.rig.trigger == "action" and (drivers != {"aravis"} or driving):
            raise ValueError("rig.trigger = 'action' needs driver = 'aravis' for both cameras, and no strobe_line")
        timed = self.rig.trigger == "action" and self.rig.action_lead_ms is not None
        if timed and not (self.cam1.ptp and self.cam2.ptp):
            raise ValueError("rig.action_lead_ms needs ptp = true for both cameras")
        return self

    @property
    def driving(self) -> CameraName | None:
        """Return the camera that drives the other by its strobe line."""
        return "cam1" if self.cam1.strobe_line else "cam2" if self.cam2.strobe_line else None

    def trigger_of(self, cam: CameraName) -> Literal["software", "hardware", "free", "action"]:
        """Return the start of one camera's exposures."""
        return self.rig.trigger if self.driving in (None, cam) else "hardware"

    def camera(self, cam: CameraName) -> CameraSection:
        """Section of one camera."""
        return self.cam1 if cam == "cam1" else self.cam2

    @model_validator(mode="after")
    def _axes_exist(self) -> Self:
        if self.stage is None:
            return self
        unused = sorted(set(self.stage.axes) - set(self.axes))
        if unused:
            raise ValueError(f"stage.axes names {unused}, but the cameras' axes are {list(self.axes)}")
        lines = self.stage.lines(self.axes)
        moved = sorted(axis for line in lines for axis in line.axes)
        if moved != list(self.axes):
            raise ValueError(f"stage.controllers move the axes {moved}, but the cameras' axes are {list(self.axes)}")
        for line in lines:
            if line.driver == "esp301" and max(line.numbers.values()) > 3:
                raise ValueError(f"an ESP301 has axes 1 to 3, {sorted(line.numbers.values())} are named")
            if line.url == "sim" and line.driver not in ("esp301", "smc100", "conex-cc"):
                raise ValueError(f"there is no simulated {line.driver}: give its url")
            groups = [(self.axis(axis).positioner or f"Group{own}").split(".")[0] for axis, own in line.numbers.items()]
            if line.driver == "xps" and len(set(groups)) < len(groups):
                raise ValueError(f"each axis of an XPS needs a group of its own, {groups} are named")
            if line.driver in ("kinesis", "standa") and len(line.axes) > 1:
                raise ValueError(f"a {line.driver} controller has one axis, {list(line.axes)} are named")
            unknown = [axis for axis in line.axes if self.axis(axis).mm_per_step is None]
            if line.driver in ("kinesis", "standa", "zaber") and unknown:
                raise ValueError(f"mm_per_step must be given for the axes {unknown} of a controller that counts steps")
            if line.driver == "zaber":
                places = [self.axis(axis).positioner or f"{own}.1" for axis, own in line.numbers.items()]
                if len(set(places)) < len(places) or not all(re.fullmatch(_ZABER_PLACE, place) for place in places):
                    raise ValueError(f"a Zaber axis is device.axis, as 2.1, and named once; {places} are named")
        return self

    @model_validator(mode="after")
    def _motion_known(self) -> Self:
        moves = self.calibration.moves
        if moves != "free":
            for name, camera in (("cam1", self.cam1), ("cam2", self.cam2)):
                for field in ("standoff_mm", "angle_deg"):
                    if getattr(camera, field) is None:
                        raise ValueError(f"{name}.{field} is needed with calibration.moves = {moves!r}")
        if moves in ("target", "both_cameras"):
            one, two = ((c.stage_axis, c.stage_sign) for c in (self.cam1, self.cam2))
            if one != two:
                raise ValueError(
                    f"calibration.moves = {moves!r} means one stage axis: stage_axis and stage_sign must "
                    f"be the same for both cameras, cam1 has {list(one)}, cam2 {list(two)}"
                )
        return self

    @property
    def home_at_start(self) -> bool:
        """Return True if opening homes the stage: it must be simulated, or the file must require it."""
        wanted = None if self.stage is None else self.stage.home_at_start
        return self.stage_is_simulated if wanted is None else wanted

    @property
    def stage_is_simulated(self) -> bool:
        """Return True if any of the stage's controllers is simulated."""
        return self.stage is not None and any(line.url == "sim" for line in self.stage.lines(self.axes))

    @property
    def simulated(self) -> list[str]:
        """Return the simulated devices, of `cam1`, `cam2` and `stage`, for records."""
        cameras = [cam for cam in CAMERAS if self.camera(cam).driver == "sim"]
        return [*cameras, *(["stage"] if self.stage_is_simulated else [])]

    @property
    def mm_per_px(self) -> float | None:
        """Return the size of a pixel at the stand-off, mean of both cameras; None if a stand-off is not stated."""
        one, two = self.cam1, self.cam2
        if one.standoff_mm is None or two.standoff_mm is None:
            return None
        return 0.5 * (one.standoff_mm / one.phd_px + two.standoff_mm / two.phd_px)

    @property
    def axes(self) -> tuple[int, ...]:
        """Stage axes that the cameras use; none without a stage."""
        return () if self.stage is None else tuple(sorted({self.cam1.stage_axis, self.cam2.stage_axis}))

    def axis(self, axis: int) -> StageSection:
        """Return the settings of one axis.

        Raises
        ------
        StageError
            ``no_stage``.
        """
        if self.stage is None:
            raise StageError(
                "The rig file has no [stage]: nothing moves, and no position is known.",
                code="no_stage",
                remedy="Add [stage] to the rig file; or take the views by hand, see `stereorig guide`.",
            )
        return self.stage.of_axis(axis)


def parse_config(text: str, *, name: str = "the rig file") -> RigConfig:
    """Read a rig file's text.

    Raises
    ------
    FileFormatError
        ``config_invalid``, one line that names the first wrong field.
    """
    remedy = "Correct the rig file; config/sim_paper.toml is a complete example."
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(f"{name} is not TOML: {error}.", code="config_invalid", remedy=remedy) from error
    try:
        return RigConfig.model_validate(data)
    except ValidationError as error:
        found = problems_in(error)
        where = found[0].field or "file"
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        cause = f"{name}: {where}: {found[0].problem}{more}."
        raise FileFormatError(cause, code="config_invalid", remedy=remedy, field=where) from error


def load_config(path: Path) -> RigConfig:
    """Read a rig file, see :func:`parse_config`."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"The rig file {path} cannot be read: {error}.",
            code="file_missing" if isinstance(error, FileNotFoundError) else "config_invalid",
            remedy="Give an existing rig file with --config.",
        ) from error
    return parse_config(text, name=str(path))
