"""Automatic assessment of a calibration: bands of the RBE, the worst views, and checks that were not made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import Float
from core.calibration.checks.agreement import DISAGREE_SHARE
from core.calibration.checks.measures import CheckMeasures, focal_lengths_px
from core.calibration.choice.screening import DroppedView
from core.calibration.choice.structure import Structure
from core.calibration.inputs import CalibrationOptions, Moves
from core.calibration.result import CheckDone, Level, Verdict, ViewResult
from core.calibration.uncertainty import VolumeUncertainty
from core.cameras.lens import LensModel
from core.names import CAMERAS

GOOD_RBE_PX, USABLE_RBE_PX = 0.1, 0.3
#: lenses sit within some per cent of the sensor's centre; a share of the image's diagonal
CENTRE_SHARE = 0.15
#: of the fitted RBE: structure of less than this moves the shape by less than the noise does
STRUCTURE_SHARE = 0.2
#: of a view's RBE; a mean residual of more is no scatter
MOVED_SHARE = 0.6
#: of all views; with more of them left out something is wrong with the way they were taken
DROPPED_SHARE = 1.0 / 3.0
_ORDER: tuple[Level, Level, Level] = ("good", "warning", "failed")


def worst(a: Level, b: Level) -> Level:
    """Return the worse of two levels."""
    return max(a, b, key=_ORDER.index)


def band(rbe_px: float) -> Level:
    """Level of an RBE; NaN fails."""
    if rbe_px <= GOOD_RBE_PX:
        return "good"
    return "warning" if rbe_px <= USABLE_RBE_PX else "failed"


def assess(
    *,
    fitted: CheckMeasures,
    held_out: CheckMeasures | None,
    views: Sequence[ViewResult],
    uncertainty: VolumeUncertainty,
    node_corrections_mm: Float | None,
    node_tolerance_mm: tuple[float, float],
    options: CalibrationOptions,
    centres: Sequence[tuple[LensModel, tuple[int, int]]] = (),
    structure: Sequence[Structure] = (),
    dropped: Sequence[DroppedView] = (),
    staged: bool = True,
    own_poses: float = 0.0,
) -> Verdict:
    """Assess a calibration.

    By the held-out RBE of each camera, the predicted uncertainty, the node corrections, structure left in the residuals
    and views that were dropped. ``own_poses``: see :func:`core.calibration.checks.agreement.share_of_own_poses`.
    """
    level: Level = "good"
    reasons: list[str] = []
    if held_out is None:
        level = "warning"
        reasons.append(
            f"No {'position' if staged else 'pose'} was held out, so that nothing independent confirms the "
            f"calibration; fitted RBE {fitted.mean.rbe_px:.4f} px."
        )
        measures, word = fitted, "Fitted"
    else:
        measures, word = held_out, "Held-out"
    for name, part in zip(CAMERAS, measures.per_camera, strict=True):
        this = band(part.rbe_px)
        level = worst(level, this)
        limit = GOOD_RBE_PX if this in ("good", "warning") else USABLE_RBE_PX
        relation = "within" if this == "good" else "above"
        reasons.append(f"{word} RBE of {name} {part.rbe_px:.4f} px is {relation} {limit:g} px.")
    if held_out is not None and (fitted_level := band(max(p.rbe_px for p in fitted.per_camera))) != "good":
        level = worst(level, fitted_level)
        reasons.append(f"Fitted RBE {fitted.mean.rbe_px:.4f} px is above {GOOD_RBE_PX:g} px.")
    typical = float(np.median([v.rbe_px for v in views]))
    ranked = sorted(views, key=lambda v: -v.rbe_px)
    bad = [v for v in ranked[:3] if v.rbe_px > max(2.0 * typical, 0.02) or v.rbe_px > GOOD_RBE_PX]
    if bad:
        reasons.append("Worst views: " + ", ".join(f"{v.name} {v.rbe_px:.3f} px" for v in bad) + ".")
        level = worst(level, band(bad[0].rbe_px))
        # the points of a view that a bump moved are off together; those of a blurred or wrongly found one are not
        together = [v for v in bad if _shift_px(v) > MOVED_SHARE * v.rbe_px]
        if staged and together:
            reasons.append(
                f"All points of {', '.join(v.name for v in together)} are off the same way: a camera, the stage or the "
                "target moved there."
            )
    if level != "good" and own_poses > DISAGREE_SHARE:
        reasons.append(
            f"The cameras disagree about where the target was: {100.0 * own_poses:.0f} % of the squared residuals of "
            "free poses would be gone if each camera had poses of its own. A camera moved between the views, or images "
            "of one number do not show one pose."
        )
    if not uncertainty.relative_shape <= options.max_shape_uncertainty:
        level = "failed"
        reasons.append(
            f"Predicted shape uncertainty {1e3 * uncertainty.shape_rms_mm:.2f} um is above "
            f"{1e3 * uncertainty.shape_rms_mm / uncertainty.relative_shape * options.max_shape_uncertainty:.2f} um."
        )
    if node_corrections_mm is not None:
        correction_mm = float(np.abs(node_corrections_mm[..., :2]).max())
        # a bound is a bound; half as much again leaves room for the estimate's own noise
        if correction_mm > 1.5 * node_tolerance_mm[0]:
            level = worst(level, "warning")
            reasons.append(
                f"Node corrections reach {1e3 * correction_mm:.1f} um against a tolerance of "
                f"{1e3 * node_tolerance_mm[0]:.1f} um: the target, its tolerance or the aspect ratio may be wrong."
            )
        bent_mm = float(np.abs(node_corrections_mm[..., 2:]).max(initial=0.0))
        if bent_mm > 1.5 * node_tolerance_mm[1]:
            level = worst(level, "warning")
            reasons.append(
                f"The target departs from a plane by {1e3 * bent_mm:.0f} um, declared are "
                f"{1e3 * node_tolerance_mm[1]:.0f} um: it was corrected, but it may bend differently from view to view."
            )
    for name, (lens, size) in zip(CAMERAS, centres, strict=False):
        cx, cy = lens.kernel_parameters()[4:6]
        off = float(np.hypot(cx - 0.5 * (size[0] - 1), cy - 0.5 * (size[1] - 1)))
        if off > CENTRE_SHARE * np.hypot(*size):
            # an axis off the optical axis moves the principal point by phd * angle, and no residual shows it
            level = worst(level, "warning")
            suspect = (
                f"its stage may travel {1e3 * off / focal_lengths_px(lens)[0]:.0f} mrad off the optical axis, or "
                if staged
                else ""
            )
            reasons.append(
                f"The principal point of {name} lies {off:.0f} px from the image's centre: {suspect}the image is a "
                "part of the sensor's."
            )
    for found in structure:
        # a misfit that the noise hides does not mislead; its uncertainty holds it
        if found.rms_px > STRUCTURE_SHARE * min(p.rbe_px for p in fitted.per_camera):
            level = worst(level, "warning")
            reasons.append(found.text)
    if dropped:
        names = ", ".join(view.name for view in dropped)
        reasons.append(f"Left out of the fit: {names}.")
        if len(dropped) > DROPPED_SHARE * (len(views) + len(dropped)):
            level = worst(level, "warning")
            reasons.append(f"{len(dropped)} of {len(views) + len(dropped)} views had to be left out.")
    return Verdict(level, tuple(reasons))


def _shift_px(view: ViewResult) -> float:
    """Length of the mean residual of a view."""
    return float(np.linalg.norm(np.nanmean(view.residual_px.reshape(-1, 2), axis=0)))


def checks_made(
    *, held_out: CheckMeasures | None, options: CalibrationOptions, moves: Moves, aspect_estimated: bool
) -> tuple[CheckDone, ...]:
    """Return the checks made and not made: a wrong scale or a tilted axis does not show in residuals."""
    staged = moves != "free"
    checks = [_held_out_done(held_out, staged=staged)]
    if staged:
        checks += [
            CheckDone(
                "positions", True, "Order, sign, unit and spacing of the positions agree with the images' scale."
            ),
            CheckDone("angles", True, "The viewing angles agree with the nominal ones and between the cameras."),
        ]
    checks.append(
        CheckDone(
            "known_distance",
            False,
            "A wrong pitch cannot be seen in the residuals: measure a known distance with both cameras.",
        )
    )
    tilt = options.axis_tilt_sigma_rad
    if moves == "cameras":
        text = (
            f"A tilt of the stage axis cannot be seen in the residuals; {1e3 * tilt:g} mrad are in the covariance."
            if tilt > 0.0
            else "A tilt of the stage axis cannot be seen in the residuals; none was declared."
        )
        checks.append(CheckDone("stage_axis", tilt > 0.0, text))
    elif staged:
        checks.append(CheckDone("stage_axis", True, "The stage's direction was found from the views."))
    if aspect_estimated:
        checks.append(CheckDone("aspect", True, "The aspect ratio was found from the free poses."))
    else:
        checks.append(CheckDone("aspect", False, "The aspect ratio was taken as given."))
    return tuple(checks)


def _held_out_done(held_out: CheckMeasures | None, *, staged: bool) -> CheckDone:
    if held_out is None:
        return CheckDone("held_out", False, f"No {'position' if staged else 'pose'} was held out.")
    parts = []
    where = sorted({round(p, 3) for c in held_out.positions_mm for p in c})
    if where:
        parts.append(f"positions {where} mm")
    frames = sorted({k for c in held_out.frames for k in c})
    if frames:
        parts.append(f"{len(frames)} poses, fitted without them")
    return CheckDone("held_out", True, f"Held-out {' and '.join(parts)}: RBE {held_out.mean.rbe_px:.4f} px.")
