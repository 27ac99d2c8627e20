"""Refusal of a target that is not flat although it was declared exact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.calibration.choice.structure import Structure
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.errors import CalibrationError

_SHARE = 0.7  # share of all residuals: a bow of more than this is half of their squares
_BENT = 4e-3  # share of the half side: a board on glass or aluminium keeps a tenth of it
_LEAST_PX = 0.05  # less than this does no harm worth a refusal; the verdict names it


def check_flatness(structure: Sequence[Structure], adjustment: Adjustment, half_side_mm: float) -> None:
    """Refuse a calibration whose residuals show above all that the target is bent.

    A slight bow, as of a printed board, is corrected like other errors of the target's points.

    Parameters
    ----------
    structure
        Structure found in the residuals.
    adjustment
        The fit, for its noise.
    half_side_mm
        Half of the target's longer side.

    Raises
    ------
    CalibrationError
        Code ``target_not_flat``.
    """
    noise = float(np.mean(adjustment.noise_px))
    for found in structure:
        if found.name != "bow" or found.rms_px < max(_SHARE * noise, _LEAST_PX):
            continue
        values = {name: value for name, (value, _) in found.terms.items()}
        bow = max(abs(values["XX_mm"]), abs(values["YY_mm"]), abs(values["XY_mm"]))
        if bow < _BENT * half_side_mm:
            continue
        raise CalibrationError(
            f"The target is not flat: it is bowed by about {bow:.2g} mm from its middle to its rim, which moves its "
            f"points by {found.rms_px:.2f} px.",
            code="target_not_flat",
            remedy="Use a rigid, flat target, or declare its errors (node_tolerance_mm, flatness_mm).",
            bow_mm=bow,
        )
