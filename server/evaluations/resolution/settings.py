"""What a user asks of the resolution study."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, field_validator

from stereorig.core.settings import STRAIN_WINDOW, SUBSET_PX
from stereorig.server.base.models import Request, StepNumber

_Positive = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
_Subset = Annotated[int, Field(ge=SUBSET_PX.low, le=SUBSET_PX.high)]
_Window = Annotated[int, Field(ge=STRAIN_WINDOW.low, le=STRAIN_WINDOW.high)]


class ResolutionSettings(Request):
    """Settings that are compared, and what the test needs."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"static_steps": [1, 2], "smallest_feature_mm": 5.0}]})

    static_steps: Annotated[list[StepNumber], Field(min_length=1, max_length=1000)] | None = Field(
        None, description="Steps in which nothing moved; null: those whose labels begin with the word static."
    )
    subsets_px: Annotated[list[_Subset], Field(max_length=10)] = Field(
        [], description="Further subsets, odd, px: the static steps are measured anew with each, from their images."
    )
    steepest_step: StepNumber | None = Field(
        None, description="Step whose steepest place is looked for; null: the last one that is not static."
    )
    spacing_multiples: Annotated[list[Annotated[int, Field(ge=1, le=20)]], Field(min_length=1, max_length=10)] = Field(
        [1, 2], description="Spacings that are compared, as multiples of the measured one."
    )
    strain_windows: Annotated[list[_Window], Field(min_length=1, max_length=20)] = Field(
        [5, 9, 15, 21], description="Strain windows that are compared, points across, odd."
    )
    smallest_feature_mm: _Positive | None = Field(
        None, description="Period of the smallest feature of the strain that must keep 90 % of its height; null: none."
    )
    strain_noise: _Positive | None = Field(
        None, description="Largest standard deviation of strain that is allowed, 1e-6 is a microstrain; null: any."
    )

    @field_validator("strain_windows", "subsets_px")
    @classmethod
    def _odd(cls, given: list[int]) -> list[int]:
        even = [one for one in given if one % 2 == 0]
        if even:
            raise ValueError(f"its entries must be odd, has {even[0]}")
        return given
