"""The curve of a tensile test: strains and stress of each step, with the errors of each and those that they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float

AXIAL, LATERAL, STRESS = 0, 1, 2
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Curve:
    """Strains and stress over n steps in the order of the test.

    Attributes
    ----------
    values
        (3, n) axial strain, lateral strain, stress in MPa, all engineering; NaN where a strain is not known.
    own
        (3, n) standard deviation of the errors that are new at each step.
    shared
        By cause (k, 3, n): what one standard deviation of each error that all steps share adds to the values.
    steps
        (n,) numbers of the steps.
    time_s
        (n,) seconds; None if one is not known.
    others
        (n,) further channels by name: those that may have got into the load.
    """

    values: Float
    own: Float
    shared: Mapping[str, Float]
    steps: NDArray[np.int64]
    time_s: Float | None = None
    others: Mapping[str, Float] = field(default_factory=dict)

    @property
    def has_lateral(self) -> bool:
        """True if there is a lateral strain."""
        return bool(np.isfinite(self.values[LATERAL]).any())


def with_load_errors(
    curve: Curve, *, scale_u: float, offset_u_mpa: float, section_u: float, late_s: float, late_u_s: float
) -> Curve:
    """Return the curve with the load dated forward, and with the errors of load, section and clock.

    Parameters
    ----------
    scale_u, section_u
        Relative standard uncertainties of the load's scale and of the section.
    offset_u_mpa
        Standard uncertainty of the stress at no load.
    late_s, late_u_s
        How much later the load's readings are than the images, and its standard uncertainty; 0 without times.
    """
    values, shared, n = curve.values.copy(), dict(curve.shared), curve.values.shape[1]
    if curve.time_s is not None and n > 2 and (late_s or late_u_s):
        values[STRESS] = np.interp(curve.time_s + late_s, curve.time_s, values[STRESS])
        shared["clock"] = _of_stress(np.gradient(values[STRESS], curve.time_s) * late_u_s)
    stress = values[STRESS]
    shared |= {"load_scale": _of_stress(stress * scale_u), "section": _of_stress(stress * section_u)}
    shared["load_offset"] = _of_stress(np.full(n, offset_u_mpa))
    return Curve(values, curve.own, shared, curve.steps, curve.time_s, curve.others)


def _of_stress(change: Float) -> Float:
    out = np.zeros((1, 3, len(change)))
    out[0, STRESS] = change
    return out
