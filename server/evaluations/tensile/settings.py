"""What a user states of a tensile test."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, model_validator
from pydantic.config import JsonDict

from stereorig.core.errors import InputError
from stereorig.core.settings import Pixel
from stereorig.server.base.models import Number, Request, Switch

Standard = Literal["iso_6892_1", "iso_527_2", "astm_d638", "astm_e8", "astm_d790"]
Positive = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
_Small = Annotated[float, Field(ge=0.0, le=0.5, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, le=1e9, allow_inf_nan=False)]
_Ends = tuple[tuple[Pixel, Pixel], tuple[Pixel, Pixel]]
_EXAMPLE: JsonDict = {
    "standard": "iso_6892_1",
    "width_mm": 12.5,
    "thickness_mm": 2.0,
    "section_u": 0.003,
    "load_scale_u": 0.003,
    "load_u_n": 2.0,
}


class TensileSettings(Request):
    """Standard, specimen, load and gauges of a tensile test."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    standard: Standard = Field("iso_6892_1", description="Standard whose windows and symbols are used.")
    width_mm: Positive | None = Field(None, description="Width of the section, with thickness_mm.")
    thickness_mm: Positive | None = Field(None, description="Thickness of the section, with width_mm.")
    diameter_mm: Positive | None = Field(None, description="Diameter of a round section.")
    section_mm2: Positive | None = Field(None, description="Area of another section.")
    section_u: _Small | None = Field(None, description="Relative standard uncertainty of the section: 0.003 is 0.3 %.")
    span_mm: Positive | None = Field(
        None, description="Distance of the supports of a bar in three-point bending; thickness_mm is its depth."
    )
    span_u: _Small = Field(0.0, description="Relative standard uncertainty of the span.")
    depth_u: _Small = Field(0.0, description="Relative standard uncertainty of the depth; section_u is the width's.")
    deflection_px: tuple[tuple[Pixel, Pixel], tuple[Pixel, Pixel], tuple[Pixel, Pixel]] | None = Field(
        None,
        description="Midspan and both supports in camera 1's image, whose deflection gives the strain; null: it is the "
        "measured strain along the bar's outer face.",
    )
    deflection_normal: Switch = Field(False, description="The deflection is along the surface's normal.")
    load_channel: Annotated[str, Field(min_length=1, max_length=100)] | None = Field(
        None, description="Channel that is the load; null: the load of the steps."
    )
    load_unit: Annotated[str, Field(min_length=1, max_length=20)] | None = Field(
        None, description="Unit of the load channel where its record states none: N, kN, lbf."
    )
    load_scale: Positive = Field(1.0, description="The load is the reading less load_zero_n, times this.")
    load_zero_n: Number = Field(0.0, description="Reading in N without a load.")
    load_scale_u: _Small | None = Field(
        None, description="Relative standard uncertainty of the load's scale; class 0.5 of ISO 7500-1 has 0.0029."
    )
    load_zero_u_n: _NotNegative = Field(0.0, description="Standard uncertainty of the load's zero, N.")
    load_u_n: _NotNegative | None = Field(
        None, description="Standard uncertainty of one reading, N, beside scale and zero; null: as it was recorded."
    )
    load_late_s: Number = Field(0.0, description="How much later the load is than the images: its lag, s.")
    load_late_u_s: _NotNegative = Field(0.0, description="Standard uncertainty of that; 0 for steps at rest.")
    direction: Literal["columns", "rows"] = Field(
        "columns", description="The specimen is pulled along the columns or the rows of camera 1's image."
    )
    pull_px: _Ends | None = Field(
        None, description="Two positions in the image along the pull, for the area's mean strain; instead of direction."
    )
    rectangle_px: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        None, description="x0, y0, x1, y1 of the area whose mean strain is used; null: the whole field."
    )
    local_px: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        None, description="x0, y0, x1, y1 of a local gauge in the neck, for true stress and strain; null: the area."
    )
    extensometer_px: _Ends | None = Field(
        None, description="Ends of an extensometer along the pull; null: the area's mean strain."
    )
    lateral_px: _Ends | None = Field(
        None, description="Ends of an extensometer across the pull; null: the area's mean strain."
    )
    lateral: Switch = Field(True, description="Read the lateral strain, for Poisson's ratio and r.")
    expected_modulus_mpa: tuple[Positive, Positive] | None = Field(
        None, description="Range of the material's modulus: a wrong load channel is noticed by it."
    )
    require: list[str] = Field(
        ["modulus"], description="Numbers without which the card is incomplete, by their keys.", max_length=20
    )
    min_steps: Annotated[int, Field(ge=3, le=1000)] = Field(5, description="Fewest steps in a window.")
    sampling_share: _Small = Field(0.01, description="Largest part of a number that may be due to too few steps.")
    r_window: tuple[Positive, Positive] = Field((0.08, 0.12), description="Plastic strains between which r is taken.")
    n_window: tuple[Positive, Positive] = Field((0.10, 0.15), description="Plastic strains between which n is taken.")

    @model_validator(mode="after")
    def _rising(self) -> Self:
        for name in ("r_window", "n_window", "expected_modulus_mpa"):
            window = getattr(self, name)
            if window is not None and window[0] >= window[1]:
                raise ValueError(f"{name} needs its lower end first, has {window[0]:g} and {window[1]:g}")
        if (self.standard == "astm_d790") != (self.span_mm is not None):
            raise ValueError("astm_d790 and span_mm need each other")
        if self.span_mm is not None and not (self.span_u and self.depth_u):
            raise ValueError("a span needs span_u and depth_u, its and the depth's relative standard uncertainty")
        return self

    @property
    def components(self) -> tuple[str, str]:
        """Components of strain along and across the pull."""
        return ("exx", "eyy") if self.pull_px is not None or self.direction == "rows" else ("eyy", "exx")

    def section(self) -> tuple[float, float]:
        """Return the section in mm2, and its relative standard uncertainty; of a bent bar, load over bending stress.

        Raises
        ------
        InputError
            ``section_missing``.
        """
        areas = [self.section_mm2]
        areas.append(None if self.diameter_mm is None else math.pi * self.diameter_mm**2 / 4.0)
        areas.append(None if self.width_mm is None or self.thickness_mm is None else self.width_mm * self.thickness_mm)
        given = [area for area in areas if area is not None]
        if self.span_mm is not None:
            given = [area * 2.0 * self.thickness_mm / (3.0 * self.span_mm) for area in given if self.thickness_mm]
        if len(given) != 1 or self.section_u is None:
            raise InputError(
                f"{len(given)} sections are stated, with {'no' if self.section_u is None else 'an'} uncertainty.",
                code="section_missing",
                remedy="State width_mm and thickness_mm, or diameter_mm, or section_mm2; and section_u.",
            )
        return given[0], self.section_u
