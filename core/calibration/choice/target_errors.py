"""Errors of a target that was declared exact: seen by every view of free poses at the same points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.structure import SIGNIFICANT, Structure
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.fit.normal import assemble
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.errors import CalibrationError
from stereorig.core.robust import f_tail

NAME = "target points"
_WEAK = 1e-9  # weight of an uninformative prior, 1/mm^2
_MARGIN = 1.2  # compensates the part of the errors that poses and lenses have absorbed


def find_target_errors(
    adjustment: Adjustment, views: Sequence[ViewRows], nominal_nodes_mm: Float, *, in_space: bool
) -> tuple[Structure, tuple[float, float]] | None:
    """Test if the residuals of all views agree on errors of the target's points, which were held.

    Parameters
    ----------
    adjustment
        A minimum with the nodes held.
    views, nominal_nodes_mm
        As it was fitted to.
    in_space
        True if the views show errors across the target's plane, too.

    Returns
    -------
    structure, node_sigma_mm
        The finding, and the standard deviations of the points within the target's plane and across it to take as a
        prior; None if the points are as declared.
    """
    open_nodes = replace(adjustment.priors, node_weight=np.array([_WEAK, _WEAK, _WEAK if in_space else np.inf]))
    normal = assemble(adjustment.layout, adjustment.state, views, nominal_nodes_mm, open_nodes, adjustment.noise_px)
    V, h = normal.nodes, normal.h
    if V.together:
        return None
    seen = np.linalg.eigvalsh(V.matrix)[:, 0] > 1e3 * _WEAK
    if seen.sum() < 6:
        return None
    inverse = np.linalg.inv(V.matrix[seen])
    d = (inverse @ h[seen][..., None])[..., 0]
    # intersections of whole lines are fewer independent figures than coordinates
    shared = float(np.mean([view.correlation for view in views]))
    gain, q = float(np.sum(d * h[seen])), float(d.size) / shared
    redundancy = float(adjustment.redundancy.sum()) / shared
    if redundancy <= q + 10.0:
        return None
    # the squares left over their own freedom; lenses and poses took up a part of the gain, so that this is careful
    left = max(redundancy - gain, 1e-9) / (redundancy - q)
    probability = f_tail((gain / q) / left, q, redundancy - q)
    if not probability < SIGNIFICANT:
        return None
    excess = d**2 - left * np.diagonal(inverse, axis1=1, axis2=2)
    within = _MARGIN * float(np.sqrt(max(0.5 * (excess[:, 0].mean() + excess[:, 1].mean()), 0.0)))
    across = _MARGIN * float(np.sqrt(max(excess[:, 2].mean(), 0.0))) if in_space else 0.0
    if within == 0.0:
        return None
    count = float(sum(view.count for view in views))
    noise = float(np.sqrt(np.mean(adjustment.noise_px**2)))
    spread = 1.0 / np.sqrt(2.0 * float(seen.sum()))
    terms = {"within_mm": (within, within * spread)}
    if in_space:
        terms["across_mm"] = (across, across * spread)
    rms = noise * float(np.sqrt(max(gain - left * q, 0.0) / count))
    return Structure(NAME, None, terms, probability, rms), (within, max(across, 1e-2 * within) if in_space else 0.0)


# Refusal of a target that is not flat although it was declared exact.

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
