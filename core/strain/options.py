"""Options of the computation of strain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.errors import InputError
from stereorig.core.settings import (
    STRAIN_ORDERS,
    STRAIN_TENSORS,
    STRAIN_WINDOW,
    StrainOrder,
    StrainSettings,
    StrainTensor,
)


@dataclass(frozen=True, kw_only=True)
class StrainOptions:
    """Options of the computation of strain from a field of displacements.

    Attributes
    ----------
    window
        Points across the square window, odd. The virtual strain gauge is (window - 1) spacing + subset wide.
    order
        1: the window's positions are fitted by planes; 2: by quadratics. In a whole window both give the same strain,
        since its quadratic terms have no effect on the slope in its middle. In a window cut by an edge, planes give the
        strain in the middle of the points left, quadratics give it at the point itself, with several times the noise.
        ``auto``: point by point the order with the smaller total error, see :mod:`stereorig.core.strain.one_sided`.
    tensor
        ``green_lagrange`` 1/2 (C - I), ``infinitesimal`` (the symmetric gradient; not free of rotation), or ``hencky``
        1/2 log C.
    min_share
        Share of the window's points that must be left if edges, holes or cuts take some away. At a half, windows on a
        straight edge are kept and those in a corner are not.
    max_amplification
        Largest ratio of the noise of a cut window's strain to a whole window's; beyond it the points are too much on
        one side.

    Raises
    ------
    InputError
        ``strain_window_invalid`` or ``option_out_of_range``.
    """

    window: int = STRAIN_WINDOW.default
    order: StrainOrder = "auto"
    tensor: StrainTensor = "green_lagrange"
    min_share: float = 0.5
    max_amplification: float = 12.0

    @staticmethod
    def of(settings: StrainSettings | None) -> StrainOptions | None:
        """Return the options of an analysis' settings; None: no strain."""
        return None if settings is None else StrainOptions(**settings.model_dump())

    def __post_init__(self) -> None:
        if not STRAIN_WINDOW.holds(self.window):
            raise InputError(
                f"the strain window is {self.window} points wide; it must be {STRAIN_WINDOW}.",
                code="strain_window_invalid",
                remedy=f"Give {STRAIN_WINDOW.default}, for example, or switch strain off.",
            )
        if self.order not in STRAIN_ORDERS:
            _refuse("order", self.order, "1, 2 or auto")
        if self.tensor not in STRAIN_TENSORS:
            _refuse("tensor", self.tensor, ", ".join(STRAIN_TENSORS))
        if not 0.0 < self.min_share <= 1.0:
            _refuse("min_share", self.min_share, "above 0 and 1 at most")
        if not (np.isfinite(self.max_amplification) and self.max_amplification >= 1.0):
            _refuse("max_amplification", self.max_amplification, "1 or more")


def _refuse(name: str, value: object, allowed: str) -> None:
    raise InputError(
        f"the strain option {name} is {value!r}, it must be {allowed}.",
        code="option_out_of_range",
        remedy=f"Give {name} as named above.",
    )
