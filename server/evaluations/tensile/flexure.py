"""A bar of width b and depth d in three-point bending over a span L (ASTM D790).

Of the outer face at midspan, under a load F and with a deflection D there,

    stress = 3 F L / (2 b d^2),    strain = 6 D d / L^2.

The load over the stress is the "section" that the settings give; the strain is measured on the face, or the
deflection's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.server.evaluations.door import Results
from stereorig.server.evaluations.histories import Deflection, History
from stereorig.server.evaluations.tensile.curve import AXIAL, STRESS, Curve
from stereorig.server.evaluations.tensile.settings import TensileSettings


def strain_of_deflection(results: Results, asked: TensileSettings) -> History:
    """Return the outer face's strain by the deflection; positive at the step where it is largest."""
    assert asked.deflection_px is not None
    assert asked.span_mm is not None
    assert asked.thickness_mm is not None
    found = results.history(Deflection(*asked.deflection_px, asked.deflection_normal))
    known = found.value[np.isfinite(found.value)]
    sign = np.sign(known[np.argmax(np.abs(known))]) if len(known) else 1.0
    scale = float(sign or 1.0) * 6.0 * asked.thickness_mm / asked.span_mm**2
    shared = {cause: scale * columns for cause, columns in found.shared.items()}
    return replace(found, value=scale * found.value, own=abs(scale) * found.own, shared=shared)


def with_beam_errors(curve: Curve, asked: TensileSettings) -> Curve:
    """Return the curve with the errors of span and depth, which stress and a deflection's strain share."""
    if asked.span_mm is None:
        return curve
    shared = dict(curve.shared)
    for cause, u, of_stress, of_strain in (("span", asked.span_u, 1.0, -2.0), ("depth", asked.depth_u, -2.0, 1.0)):
        column = np.zeros((1, *curve.values.shape))
        column[0, STRESS] = of_stress * u * curve.values[STRESS]
        if asked.deflection_px is not None:
            column[0, AXIAL] = of_strain * u * np.nan_to_num(curve.values[AXIAL])
        shared[cause] = column
    return replace(curve, shared=shared)
