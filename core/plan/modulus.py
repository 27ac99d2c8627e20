"""What is stated of a planned tensile test or cracked panel, and the uncertainty of the modulus that it would give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import Field, model_validator

from stereorig.core.plan.settings import Positive
from stereorig.core.settings import Real, Settings, Whole, disagreement

_Strain = Annotated[Real, Field(ge=0.0, le=0.5)]


class PlannedTensileTest(Settings):
    """The tensile test whose modulus is predicted."""

    modulus_strains: tuple[_Strain, _Strain] = Field(
        (0.0005, 0.0025), description="Strains between which the modulus is taken."
    )
    modulus_steps: Annotated[Whole, Field(ge=3, le=100_000)] = Field(
        20, description="Steps between these strains, evenly spread."
    )
    load_class: Annotated[Real, Field(ge=0.0, le=10.0)] | None = Field(
        None, description="Class of the load cell, ISO 7500-1: 0.5 is an error of up to 0.5 %."
    )
    section_u: Annotated[Real, Field(ge=0.0, le=0.5)] | None = Field(
        None, description="Relative standard uncertainty of the section: 0.003 is 0.3 %."
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.modulus_strains[0] >= self.modulus_strains[1]:
            raise disagreement("modulus_strains needs its lower end first")
        return self


class PlannedCrack(Settings):
    """The centre-cracked panel whose stress intensity is predicted; its crack runs along X to a tip in the middle."""

    crack_half_mm: Positive | None = Field(None, description="Half of the crack's length.")
    panel_width_mm: Positive | None = Field(None, description="Width of the panel.")
    panel_thickness_mm: Positive | None = Field(None, description="Its thickness.")
    panel_load_n: Positive | None = Field(None, description="Load that pulls it across the crack.")
    youngs_modulus_mpa: Positive | None = Field(None, description="Young's modulus.")
    poisson: Annotated[Real, Field(ge=0.0, lt=0.5)] = Field(0.33, description="Poisson's ratio.")
    modulus_u: Annotated[Real, Field(ge=0.0, le=0.5)] | None = Field(
        None, description="Relative standard uncertainty of the modulus."
    )
    ring_mm: tuple[Positive, Positive] | None = Field(
        None, description="Distances from the tip of the points; null: a subset and a half, and half the crack."
    )


def modulus_parts(test: PlannedTensileTest, noise: float, moved: float) -> Mapping[str, float]:
    """Return the relative standard uncertainties of the modulus by cause; those that are not stated are left out.

    Parameters
    ----------
    test
        The test.
    noise
        Standard deviation of the gauge's strain that is new at each step.
    moved
        Strain that the cameras' errors add while the body moves as far as during the test; it grows with the load. An
        error that all steps have alike, as the reference's noise, shifts the line and does not turn it.
    """
    low, high = test.modulus_strains
    n = test.modulus_steps
    # root of the sum of squares of n even steps about their mean
    spread = (high - low) * math.sqrt(n * (n + 1) / (12.0 * (n - 1)))
    parts = {"noise": noise / spread, "cameras": moved / (high - low)}
    if test.load_class is not None:
        # an error within +- its class, equally likely
        parts["load"] = 0.01 * test.load_class / math.sqrt(3.0)
    if test.section_u is not None:
        parts["section"] = test.section_u
    return parts
