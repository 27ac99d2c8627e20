"""Outcome of the comparison of a field with a model."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import InputError
from stereorig.core.model.filtered import ModelField
from stereorig.core.model.placement import Placement
from stereorig.core.model.regions import ChiSquare, Tiles


class ModelStatus(IntEnum):
    """Status of a point in a comparison; every status but ``COMPARED`` means that it takes no part."""

    COMPARED = 0
    NOT_MEASURED = 1
    NO_MODEL = 2


MODEL_STATUS_MEANINGS: dict[ModelStatus, str] = {
    ModelStatus.COMPARED: "measured, and over the model",
    ModelStatus.NOT_MEASURED: "not measured",
    ModelStatus.NO_MODEL: "measured, but the model has no surface there",
}


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Options of a comparison.

    Attributes
    ----------
    tile_px
        Width of a region, px of camera 1's reference image; None: an eighth of the field, two subsets at least.
    confidence
        Share of right models that are accepted.
    remove_rigid
        True: the rigid motion between both displacements, which a model rarely has, is fitted and taken out.
    load_uncertainty
        Relative standard uncertainty of the load (and of all else that the model's displacement is in proportion to).
    systematic_mm
        Standard size of errors of U, V, W that noise does not contain (interpolation), taken as one value a region;
        zero if none is known.
    far_mm
        Points farther than this from the placed model's surface are not on it; None: a fiftieth of the field's size.

    Raises
    ------
    InputError
        ``option_out_of_range``.
    """

    tile_px: float | None = None
    confidence: float = 0.95
    remove_rigid: bool = False
    load_uncertainty: float = 0.0
    systematic_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far_mm: float | None = None

    def __post_init__(self) -> None:
        """Raise an error for a value out of range."""
        checks = (
            ("tile_px", self.tile_px is None or self.tile_px > 0.0, "above 0"),
            ("confidence", 0.5 <= self.confidence < 1.0, "0.5 to below 1"),
            ("load_uncertainty", 0.0 <= self.load_uncertainty <= 1.0, "0 to 1"),
            ("systematic_mm", all(v >= 0.0 for v in self.systematic_mm), "0 or more"),
            ("far_mm", self.far_mm is None or self.far_mm > 0.0, "above 0"),
        )
        for name, holds, allowed in checks:
            if not holds:
                raise InputError(
                    f"the option {name} is {getattr(self, name)!r}, it must be {allowed}.",
                    code="option_out_of_range",
                    remedy=f"Give {name} as named above.",
                )


@dataclass(frozen=True, eq=False)
class Compared:
    """Difference of three quantities over the points and by region: measured less model.

    Attributes
    ----------
    measured, model, difference, sigma, z
        (r, c, 3) values, their difference, its standard uncertainty with the common part, and one over the other; NaN
        where not compared.
    tile_difference, tile_sigma
        (t, 3) means over the regions and their standard uncertainties.
    verdicts
        Verdict of each region, from its own three means.
    refuted
        (t,) True for regions in which the model is refuted, at the confidence for all regions together (Holm).
    overall
        For the whole field, all means together.
    accepted
        True if the model is not refuted by the field as a whole.
    scale, pattern, local
        The parts that are judged: the part of ``overall`` in proportion to the model's displacement (one degree of
        freedom: a stiffness or load that is wrong), the rest of it, and the region that fits worst. None if the verdict
        is not based on them.
    """

    measured: Float
    model: Float
    difference: Float
    sigma: Float
    tile_difference: Float
    tile_sigma: Float
    verdicts: tuple[ChiSquare, ...]
    refuted: Bool
    overall: ChiSquare
    accepted: bool
    scale: ChiSquare | None = None
    pattern: ChiSquare | None = None
    local: ChiSquare | None = None

    @property
    def z(self) -> Float:
        """(r, c, 3) difference over its standard uncertainty."""
        return np.divide(self.difference, self.sigma, out=np.full_like(self.difference, np.nan), where=self.sigma > 0.0)


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """A field compared with a model.

    Attributes
    ----------
    options
        Options of the comparison.
    status
        (r, c) int8, :class:`ModelStatus`.
    placement
        Placement of the model.
    at_points
        The model at the points.
    tiles
        The regions.
    displacement
        U, V, W, mm.
    strain
        exx, eyy, exy by the measurement's own window; None if none was measured.
    factor, factor_sigma
        Best factor from the model's displacement to the measured one, and its standard uncertainty without the load's;
        NaN if the model does not move.
    rigid
        (6,) rigid motion that was removed: turns about X, Y, Z (rad) and shifts of the points' middle (mm); None if
        none was.
    left_out
        Number of the displacement's component that a plane model does not have, 0 for U to 2 for W: the other two are
        along the model's plane, by the smallest turn of the axes into it. None if all three were compared.
    shape_rms_mm, shape_ratio
        Height of the measured points above the model's surface, root mean square, and in units of its noise.
    """

    options: CompareOptions
    status: NDArray[np.int8]
    placement: Placement
    at_points: ModelField
    tiles: Tiles
    displacement: Compared
    strain: Compared | None
    factor: float
    factor_sigma: float
    rigid: Float | None
    shape_rms_mm: float
    shape_ratio: float
    left_out: int | None = None

    @property
    def accepted(self) -> bool:
        """True if neither the displacement nor the strain refutes the model."""
        return self.displacement.accepted and (self.strain is None or self.strain.accepted)
