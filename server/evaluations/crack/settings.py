"""What a user states of a crack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from stereorig.core.errors import InputError
from stereorig.core.settings import PixelPosition
from stereorig.server.base.models import Request

State = Literal["plane_stress", "plane_strain"]
_Positive = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
_Small = Annotated[float, Field(ge=0.0, le=0.5, allow_inf_nan=False)]
_Channel = Annotated[str, Field(min_length=1, max_length=100)]
_EXAMPLE: JsonDict = {
    "youngs_modulus": 73.1,
    "modulus_unit": "GPa",
    "modulus_u": 0.01,
    "poisson": 0.33,
    "poisson_u": 0.01,
    "crack_px": [[40.0, 105.0], [96.0, 105.0]],
    "inner_mm": 0.4,
    "outer_mm": 1.1,
}
_IN_MPA = {"MPa": 1.0, "GPa": 1e3}


@dataclass(frozen=True)
class Elastic:
    """An isotropic, linear elastic sheet: E in MPa, nu, and whether stress or strain is plane."""

    youngs_modulus: float
    poisson: float
    state: State = "plane_stress"

    @property
    def two_g(self) -> float:
        """Twice the shear modulus, MPa."""
        return self.youngs_modulus / (1.0 + self.poisson)

    @property
    def kappa(self) -> float:
        """Kolosov's constant."""
        nu = self.poisson
        return (3.0 - nu) / (1.0 + nu) if self.state == "plane_stress" else 3.0 - 4.0 * nu

    @property
    def effective(self) -> tuple[float, float]:
        """Modulus in MPa and Poisson's ratio with which the formulas of plane stress hold."""
        e, nu = self.youngs_modulus, self.poisson
        return (e, nu) if self.state == "plane_stress" else (e / (1.0 - nu**2), nu / (1.0 - nu))


class CrackSettings(Request):
    """Material, crack, and area of its evaluation."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    youngs_modulus: _Positive | None = Field(None, description="Young's modulus, in modulus_unit.")
    modulus_unit: Literal["MPa", "GPa"] | None = Field(None, description="Unit of the modulus.")
    modulus_u: _Small | None = Field(None, description="Relative standard uncertainty of the modulus: 0.01 is 1 %.")
    poisson: Annotated[float, Field(ge=0.0, lt=0.5)] | None = Field(None, description="Poisson's ratio.")
    poisson_u: _Small | None = Field(None, description="Standard uncertainty of Poisson's ratio.")
    state: State = Field("plane_stress", description="Stress state; the surface that is measured is in plane stress.")
    crack_px: Annotated[list[PixelPosition], Field(min_length=2, max_length=1000)] | None = Field(
        None, description="Line of the crack in camera 1's reference image; null: the drawn one."
    )
    tip: Literal["first", "last"] = Field("last", description="End of the line that is the tip.")
    direction_u_deg: Annotated[float, Field(ge=0.0, le=10.0)] | None = Field(
        None, description="Standard uncertainty of the crack's direction, degrees; null: 1 px over its straight part."
    )
    inner_mm: _Positive | None = Field(
        None, description="Distance from the tip within which no point is used; null: a subset and a half."
    )
    outer_mm: _Positive | None = Field(
        None, description="Distance up to which points are used; null: half the crack, within the field."
    )
    max_order: Annotated[int, Field(ge=5, le=14)] = Field(10, description="Highest order of the series.")
    criterion: Literal["aic", "bic"] = Field("aic", description="Criterion of information that chooses the order.")
    ctod_mm: _Positive | None = Field(
        None, description="Distance behind the tip at which the tip's opening is read; null: that of inner_mm."
    )
    cycles_channel: _Channel | None = Field(None, description="Channel with the count of load cycles; null: none.")
    panel: tuple[_Positive, _Positive, _Small] | None = Field(
        None, description="Centre-cracked panel for K_I's formula: width, thickness in mm, relative u of its stress."
    )

    def elastic(self) -> Elastic:
        """Return the material.

        Raises
        ------
        InputError
            ``modulus_missing``, ``modulus_unit_missing``.
        """
        if self.youngs_modulus is not None and self.modulus_unit is None:
            raise InputError(
                f"The modulus {self.youngs_modulus:g} is stated without its unit.",
                code="modulus_unit_missing",
                remedy="State modulus_unit, MPa or GPa.",
            )
        needed = ("youngs_modulus", "modulus_u", "poisson", "poisson_u")
        missing = [name for name in needed if getattr(self, name) is None]
        if self.youngs_modulus is None or self.poisson is None or self.modulus_unit is None or missing:
            raise InputError(
                f"Displacements give stresses with a modulus alone; {', '.join(missing)} missing.",
                code="modulus_missing",
                remedy="State youngs_modulus with modulus_unit and modulus_u, and poisson with poisson_u.",
            )
        return Elastic(self.youngs_modulus * _IN_MPA[self.modulus_unit], self.poisson, self.state)

    def ring_mm(self, subset_mm: float, longest_mm: float) -> tuple[float, float]:
        """Return the inner and the outer distance from the tip, by a subset's width and the largest outer distance.

        Raises
        ------
        InputError
            ``crack_ring_invalid``.
        """
        inner = 1.5 * subset_mm if self.inner_mm is None else self.inner_mm
        outer = longest_mm if self.outer_mm is None else self.outer_mm
        least = 0.75 * subset_mm
        if not (np.isfinite(outer) and inner >= least and outer >= 2.0 * inner):
            raise InputError(
                f"The ring about the tip reaches from {inner:.4g} to {outer:.4g} mm; a subset has {subset_mm:.4g} mm.",
                code="crack_ring_invalid",
                remedy=f"State inner_mm of {least:.3g} or more and outer_mm of twice that or more, or measure with "
                "smaller subsets.",
            )
        return inner, outer
