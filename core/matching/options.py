"""Options of the matcher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from stereorig.core.errors import InputError
from stereorig.core.settings import SINGLE_MAX_SIGMA_PX, SUBSET_PX, Interpolation

Patch = Literal["rigid", "affine", "quadratic"]
PATCHES: tuple[Patch, ...] = get_args(Patch)

FIRST_RATE = 0.1
"""Convergence rate assumed for an unknown one: on poor images nine points of ten are at least this fast."""

SPLINE_ORDER: dict[str, int] = {"cubic": 3, "quintic": 5}


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Options of :func:`stereorig.core.matching.fit_shape` and :func:`stereorig.core.matching.fit_motion`.

    Attributes
    ----------
    subset_px
        Width and height of the square subset in camera 1, px.
    patch
        ``affine`` (12 unknowns, the default) or ``rigid`` (the paper's 9): a plane that moves; shape is a plane with
        both. ``quadratic``: a second-order surface (6 unknowns) with a second-order displacement (18 more).
    interpolation
        Spline that the images were prepared with; ``cubic`` is faster, and biased on sharp speckle.
    max_iterations
        Gauss-Newton steps before a point counts as not converged. Points inside the basin need 2 to 8.
    tolerance_px
        Motion of the subset's corners that may remain unmade when the iteration stops, px. Its own noise is some ten
        times larger at the default.
    first_rate
        A step's motion over the motion of the step before, assumed after a point's first step: if the first moves
        little, it is the only one. Below 0.9. Below 0.9.
    max_sigma_px
        Points whose match has a larger predicted standard deviation, px, in any image and direction have too little
        texture: five times as much, half a pixel, is exceeded once in two million. A texture of stripes fails this test
        too.
    max_step_px
        A Gauss-Newton step that moves a corner of the subset further is cut down to this, px.
    """

    subset_px: int = SUBSET_PX.default
    patch: Patch = "affine"
    interpolation: Interpolation = "quintic"
    max_iterations: int = 30
    tolerance_px: float = 1e-3
    first_rate: float = FIRST_RATE
    max_sigma_px: float = SINGLE_MAX_SIGMA_PX
    max_step_px: float = 4.0

    def __post_init__(self) -> None:
        if not SUBSET_PX.holds(self.subset_px):
            raise InputError(f"subset_px is {self.subset_px}, it must be {SUBSET_PX}.", code="option_out_of_range")
        if self.patch not in PATCHES:
            raise InputError(
                f"patch is {self.patch!r}, it must be 'rigid', 'affine' or 'quadratic'.", code="option_out_of_range"
            )
        if self.interpolation not in SPLINE_ORDER:
            raise InputError(
                f"interpolation is {self.interpolation!r}, it must be 'cubic' or 'quintic'.", code="option_out_of_range"
            )
        if self.max_iterations < 1:
            raise InputError(
                f"max_iterations is {self.max_iterations}, it must be 1 or more.", code="option_out_of_range"
            )
        if not 0.0 <= self.first_rate < 0.9:
            raise InputError(f"first_rate is {self.first_rate}, it must be in 0 to 0.9.", code="option_out_of_range")
        for name in ("tolerance_px", "max_sigma_px", "max_step_px"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise InputError(f"{name} is {value}, it must be positive and finite.", code="option_out_of_range")
