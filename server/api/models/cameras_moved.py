"""Whether a camera moved, as it travels with each step's figures."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from server.base.models import Reply


class MotionConsequence(Reply):
    """What the change of orientation makes of the points, were it not known."""

    shape_um: float = Field(description="Rms error of shape, rigid motion taken out.")
    shape_sigma_um: float = Field(description="Its standard uncertainty.")
    z_um: float = Field(description="Rms error of Z.")
    z_sigma_um: float = Field(description="Its standard uncertainty.")
    displacement_um: float = Field(description="Rms displacement of a specimen at rest, before to after.")
    displacement_sigma_um: float = Field(description="Its standard uncertainty.")
    strain_microstrain: float = Field(description="Largest strain of that false displacement.")
    strain_sigma_microstrain: float = Field(description="Its standard uncertainty.")


class OffsetFinding(Reply):
    """A step's epipolar offsets against the calibration's, the reference's or those of the step before."""

    against: Literal["calibration", "reference", "last_step"] = Field(description="What they are held against.")
    camera_moved: bool | None = Field(description="null: the calibration's own error is not known.")
    points: int = Field(description="Number of points.")
    offset_mean_px: float = Field(description="Mean of the smooth offset, or of its change.")
    offset_rms_px: float = Field(description="Its root mean square.")
    expected_px: float = Field(description="What noise, systematic errors and the calibration's uncertainty explain.")
    pattern_px: dict[str, float] = Field(description="Rms of its `mean`, `slope` and `curvature` over the image.")
    carried_by: Literal["mean", "slope", "curvature"] = Field(description="The largest of these.")
    chi_square: float = Field(description="Six terms against what is expected.")
    p_value: float = Field(description="Chance of so large an offset without a motion.")
    sigmas: float = Field(description="The same in standard deviations.")
    change_deg: list[float] = Field(
        description="Turn of camera 2 about its x, y, z, and of the baseline's direction forward and sideways, degrees."
    )
    change_sigma_deg: list[float] = Field(description="Standard uncertainties.")
    determined: float = Field(description="How many of these five the offsets determine.")
    consequence: MotionConsequence | None = Field(description="Consequence of that change.")
    text: str = Field(description="The finding in a sentence.")


class CameraMotion(Reply):
    """Whether a camera moved since the calibration, the reference or the step before."""

    camera_moved: bool | None = Field(description="True, false, or null where that cannot be told.")
    text: str = Field(description="The finding in a sentence.")
    calibration: OffsetFinding | None = Field(description="Against the calibration.")
    reference: OffsetFinding | None = Field(description="Against the reference; null for the reference itself.")
    last_step: OffsetFinding | None = Field(description="Against the step before; null where that is the reference.")
