"""The rig file: one closed model, with a description on every field.

The same TOML file serves ``stereorig serve`` and, as far as the nominal camera data go, ``stereorig calibrate``. A
key that is not known is an error, not a silent nothing; errors are one line that names the field.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from core.errors import FileFormatError

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
CameraName = Literal["cam1", "cam2"]


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RigSection(_Closed):
    """[rig]: the whole."""

    name: str = Field(description="Name of the rig, shown to users and kept with every result.", max_length=200)
    kind: Literal["simulated", "real"] = Field(description="`simulated` starts a simulated world with its controllers.")
    max_skew_ms: Positive = Field(5.0, description="A pair whose exposures began further apart is refused.")
    description: str = Field("", description="Free text for people.", max_length=2000)


class CameraSection(_Closed):
    """[cam1], [cam2]: nominal data, driver and stage axis of one camera."""

    image_size_px: tuple[Annotated[int, Field(ge=16, le=32767)], Annotated[int, Field(ge=16, le=32767)]] = Field(
        description="Width and height of the image."
    )
    phd_px: Positive = Field(description="Nominal pinhole distance in column pitches (focal length over pixel pitch).")
    standoff_mm: Positive = Field(description="Nominal distance from the pinhole to the target.")
    angle_deg: Annotated[float, Field(gt=-90.0, lt=90.0)] = Field(description="Nominal gamma of Eq. (1).")
    aspect: Positive = Field(1.0, description="Rows' scale over columns' scale (lambda).")
    bit_depth: Literal[8, 10, 12, 14, 16] = Field(8, description="Significant bits per pixel.")
    driver: Literal["sim", "aravis", "v4l2"] = Field("sim", description="Frame grabber driver.")
    device: str | None = Field(None, description="The driver's name of the device; the simulated rig needs none.")
    stage_axis: int = Field(1, ge=1, le=6, description="Stage axis that moves this camera along its optical axis.")
    stage_sign: Literal[-1, 1] = Field(
        1, description="dZ = sign * (position - zero), dZ positive away from the target."
    )
    exposure_ms: Positive | None = Field(None, description="Exposure set when the camera is opened.")
    gain_db: Finite | None = Field(None, description="Gain set when the camera is opened.")


class StageSection(_Closed):
    """[stage]: the motion controller."""

    driver: Literal["esp301", "smc100"] = Field(description="Protocol of the controller.")
    url: str = Field(description="pyserial URL or port; `sim` starts a simulated controller.", min_length=1)
    soft_limits_mm: tuple[Finite, Finite] = Field(description="Lowest and highest position; tightens the controller's.")
    velocity_mm_s: Positive | None = Field(None, description="Velocity set when the stage is opened.")
    acceleration_mm_s2: Positive | None = Field(None, description="Acceleration set when the stage is opened.")
    backlash_mm: Annotated[float, Field(ge=0.0)] = Field(0.0, description="Every move arrives with this much travel.")
    approach_from: Literal["below", "above"] = Field(
        "below", description="Side that every position is arrived at from."
    )
    settle_ms: Annotated[float, Field(ge=0.0, le=60000.0)] = Field(0.0, description="Wait after the end of motion.")
    tolerance_mm: Positive = Field(0.002, description="A position read back further from its target is a fault.")
    zero_mm: Finite = Field(0.0, description="Stage position of dZ = 0, where the cameras measure.")
    home_at_start: bool | None = Field(None, description="Home when opened; only simulated stages do if left out.")

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        low, high = self.soft_limits_mm
        if not low < high:
            raise ValueError(f"soft_limits_mm must be [low, high] with low < high, got [{low}, {high}]")
        return self


class TargetSection(_Closed):
    """[target]: the precision line grid."""

    pitch_mm: Positive = Field(description="Distance of neighbouring lines.")
    lines: tuple[Annotated[int, Field(ge=3, le=201)], Annotated[int, Field(ge=3, le=201)]] = Field(
        description="Number of lines crossed when walking along X_sys and along Y_sys."
    )
    line_width_mm: Positive = Field(description="Width of a line.")
    node_tolerance_mm: Annotated[float, Field(ge=0.0)] = Field(0.0, description="Maker's tolerance of the line places.")
    dark_lines: bool = Field(True, description="Dark lines on a bright ground, or the other way round.")


class CalibrationSection(_Closed):
    """[calibration]: the usual plan; a request can give another one."""

    positions_mm: tuple[Finite, ...] = Field(description="dZ of the fitted positions.", min_length=1, max_length=100)
    held_out_mm: tuple[Finite, ...] = Field((), description="dZ of the positions kept for the check.", max_length=100)
    frames: int = Field(4, ge=1, le=256, description="Frames averaged at each position.")
    localiser: Literal["profile", "paper"] = Field("profile", description="Grid line localiser.")
    axis_tilt_sigma_rad: Annotated[float, Field(ge=0.0, le=0.1)] = Field(
        0.0, description="Prior on the angle between stage axis and optical axis; carried into the covariance."
    )


class ServiceSection(_Closed):
    """[service]: limits of the service itself."""

    compute_queue: int = Field(16, ge=1, le=1000, description="Computations that may wait; beyond it 503.")
    kernel_threads: int | None = Field(
        None, ge=1, le=256, description="Kernel threads of the worker; all cores if left out."
    )


class RigConfig(_Closed):
    """A rig file."""

    rig: RigSection
    cam1: CameraSection
    cam2: CameraSection
    stage: StageSection
    target: TargetSection
    calibration: CalibrationSection
    service: ServiceSection = ServiceSection()  # type: ignore[call-arg]  # pydantic fills the defaults
    sim: dict[str, Any] | None = Field(None, description="The simulated world's truth; its own part reads it.")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.rig.kind == "simulated":
            if self.sim is None:
                raise ValueError("a simulated rig needs a [sim] table")
            if self.stage.url != "sim" or self.cam1.driver != "sim" or self.cam2.driver != "sim":
                raise ValueError("a simulated rig needs stage.url = 'sim' and driver = 'sim' for both cameras")
        return self

    def camera(self, cam: CameraName) -> CameraSection:
        """Section of one camera."""
        return self.cam1 if cam == "cam1" else self.cam2

    @model_validator(mode="after")
    def _axes_exist(self) -> Self:
        if self.stage.driver == "esp301" and max(self.axes) > 3:
            raise ValueError(f"an ESP301 has axes 1 to 3, the cameras name {list(self.axes)}")
        return self

    @property
    def home_at_start(self) -> bool:
        """Whether opening homes the stage: nothing moves by itself unless it is simulated or the file says so."""
        wanted = self.stage.home_at_start
        return self.rig.kind == "simulated" if wanted is None else wanted

    @property
    def axes(self) -> tuple[int, ...]:
        """Stage axes that the cameras use."""
        return tuple(sorted({self.cam1.stage_axis, self.cam2.stage_axis}))


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
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        cause = f"{name}: {where}: {first['msg']}{more}."
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
