"""Automatic assessment of a calibration: bands of the RBE, the worst views, and checks that were not made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.agreement import DISAGREE_SHARE, lens_faults
from stereorig.core.calibration.checks.measures import CheckMeasures, focal_lengths_px
from stereorig.core.calibration.choice.contradictions import FAILED_LEVEL
from stereorig.core.calibration.choice.declared import ASPECTS, DECLARED, SCALE, SCALE_GROUPS
from stereorig.core.calibration.choice.screening import DroppedView
from stereorig.core.calibration.choice.structure import UNEQUAL_PITCH, Structure
from stereorig.core.calibration.fit.layout import ASPECT_SIGMA
from stereorig.core.calibration.inputs import CalibrationOptions, Moves
from stereorig.core.calibration.result import CheckDone, Level, Verdict, ViewResult
from stereorig.core.calibration.uncertainty import VolumeUncertainty
from stereorig.core.cameras.lens import LensModel
from stereorig.core.names import CAMERAS

GOOD_RBE_PX, USABLE_RBE_PX = 0.1, 0.3
_LIMIT_PX: dict[Level, float] = {"warning": GOOD_RBE_PX, "failed": USABLE_RBE_PX}
#: lenses sit within some per cent of the sensor's centre; a share of the image's diagonal
CENTRE_SHARE = 0.15
#: of the fitted RBE: errors of the target's points of less than this are hidden by the noise
STRUCTURE_SHARE = 0.2
#: of a view's RBE; a mean residual of more is no scatter
MOVED_SHARE = 0.6
#: of all views; with more of them left out something is wrong with the way they were taken
DROPPED_SHARE = 0.4
#: times the reported error of the shape; a scale of the stage that no certificate states must not make more of it
UNSEEN_FACTOR = 2.0
_ORDER: tuple[Level, Level, Level] = ("good", "warning", "failed")
_AT_REST = "Take the views again, sharp, with cameras, stage and target at rest; check the target's description."
_MORE_VIEWS = "Take more views, farther apart."
_ANOTHER_LENS = "Show the target over the whole image, or ask for a simpler lens."
_MEASURE = "Measure the target's pitch and the stage's travel, and declare both and the aspect ratio as they are."


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
    fitted_shape_mm: float,
    unseen_scale: tuple[float, float] | None = None,
    node_corrections_mm: Float | None,
    node_tolerance_mm: tuple[float, float],
    options: CalibrationOptions,
    centres: Sequence[tuple[LensModel, tuple[int, int]]] = (),
    structure: Sequence[tuple[Structure, Float | None]] = (),
    dropped: Sequence[DroppedView] = (),
    staged: bool = True,
    own_poses: float = 0.0,
    remarks: Sequence[str] = (),
) -> Verdict:
    """Assess a calibration.

    By the held-out RBE of each camera, the predicted uncertainty, the node corrections, structure left in the residuals
    and views that were dropped; what passes is a reason of a good verdict only. ``structure`` pairs each structure with
    its shift of measured points, (3 n,) mm without a rigid motion, or None; ``fitted_shape_mm`` is the shape's error
    without them. ``unseen_scale`` is an error of the stage's scale that may be, with its shift. ``own_poses``: see
    :func:`stereorig.core.calibration.checks.agreement.share_of_own_poses`. ``remarks`` are further warnings.
    """
    level: Level = "good"
    passed: list[str] = []
    found: list[tuple[Level, str, str]] = []

    def note(this: Level, text: str, remedy: str = "") -> None:
        nonlocal level
        level = worst(level, this)
        found.append((this, text, remedy))

    if held_out is None:
        note(
            "warning",
            f"No {'position' if staged else 'pose'} was held out, and there are too few to leave any out, so that "
            f"nothing independent confirms the calibration; fitted RBE {fitted.mean.rbe_px:.4f} px.",
        )
    for word, measures in (("Held-out", held_out), ("Fitted", fitted)):
        for name, part in zip(CAMERAS, measures.per_camera if measures is not None else (), strict=False):
            if (this := band(part.rbe_px)) != "good":
                note(this, f"{word} RBE of {name} {part.rbe_px:.4f} px is above {_LIMIT_PX[this]:g} px.", _AT_REST)
            elif measures is held_out:
                passed.append(f"{word} RBE of {name} {part.rbe_px:.4f} px is within {GOOD_RBE_PX:g} px.")
    typical = float(np.median([v.rbe_px for v in views]))
    ranked = sorted(views, key=lambda v: -v.rbe_px)
    bad = [v for v in ranked[:3] if v.rbe_px > max(2.0 * typical, 0.02) or v.rbe_px > GOOD_RBE_PX]
    if bad:
        this = band(bad[0].rbe_px)
        if not staged and this == "failed":
            # free poses are many: the RBE of all of them, held out and fitted, shows if one spoils the others
            this = "warning"
        broken = f" (a view's limit is {_LIMIT_PX[this]:g} px)" if this != "good" else ""
        note(this, "Worst views: " + ", ".join(f"{v.name} {v.rbe_px:.3f} px" for v in bad) + f"{broken}.", _AT_REST)
        # the points of a view that a bump moved are displaced together; in a blurred or wrongly found view they are not
        together = [v for v in bad if _shift_px(v) > MOVED_SHARE * v.rbe_px]
        if staged and together:
            note(
                this,
                f"All points of {', '.join(v.name for v in together)} are off the same way: a camera, the stage or the "
                "target moved there.",
                _AT_REST,
            )
    if level != "good" and own_poses > DISAGREE_SHARE:
        note(
            level,
            f"The cameras disagree about where the target was: {100.0 * own_poses:.0f} % of the squared residuals of "
            "free poses would be gone if each camera had poses of its own. A camera moved between the views, or images "
            "of one number do not show one pose.",
            _AT_REST,
        )
    if not uncertainty.relative_shape <= options.max_shape_uncertainty:
        note(
            "failed",
            f"Predicted shape uncertainty {1e3 * uncertainty.shape_rms_mm:.2f} um is above "
            f"{1e3 * uncertainty.shape_rms_mm / uncertainty.relative_shape * options.max_shape_uncertainty:.2f} um.",
            _MORE_VIEWS,
        )
    if node_corrections_mm is not None:
        correction_mm = float(np.abs(node_corrections_mm[..., :2]).max())
        # a bound is a bound; half as much again leaves room for the estimate's own noise
        if correction_mm > 1.5 * node_tolerance_mm[0]:
            note(
                "warning",
                f"Node corrections reach {1e3 * correction_mm:.1f} um against a tolerance of "
                f"{1e3 * node_tolerance_mm[0]:.1f} um: the target, its tolerance or the aspect ratio may be wrong.",
            )
        bent_mm = float(np.abs(node_corrections_mm[..., 2:]).max(initial=0.0))
        if bent_mm > 1.5 * node_tolerance_mm[1]:
            note(
                "warning",
                f"The target departs from a plane by {1e3 * bent_mm:.0f} um, declared are "
                f"{1e3 * node_tolerance_mm[1]:.0f} um: it was corrected, but it may bend otherwise in each view.",
            )
    for name, (lens, size) in zip(CAMERAS, centres, strict=False):
        cx, cy = lens.kernel_parameters()[4:6]
        off = float(np.hypot(cx - 0.5 * (size[0] - 1), cy - 0.5 * (size[1] - 1)))
        if off > CENTRE_SHARE * np.hypot(*size):
            # an axis off the optical axis moves the principal point by phd * angle, and no residual shows it
            suspect = (
                f"its stage may travel {1e3 * off / focal_lengths_px(lens)[0]:.0f} mrad off the optical axis, or "
                if staged
                else ""
            )
            note(
                "warning",
                f"The principal point of {name} lies {off:.0f} px from the image's centre: {suspect}the image is a "
                "part of the sensor's.",
            )
    for name, (lens, size) in zip(CAMERAS, centres, strict=False):
        faults, folded = lens_faults(lens, size)
        if faults:
            text = f"{name} has a lens that no lens is: {', and '.join(faults)}."
            note("failed" if folded else "warning", text, _ANOTHER_LENS)
    moves = [moved for one, moved in structure if moved is not None and one.name not in DECLARED]
    together_mm = _rms(np.sum(moves, axis=0)) if moves else 0.0
    least_mm = min(fitted_shape_mm, max((_rms(m) for m in moves), default=0.0))
    for one, moved in structure:
        if one.name in DECLARED:
            off = abs(one.terms.get(SCALE, (np.inf, 0.0))[0])
            certain = one.probability < FAILED_LEVEL and off > options.max_shape_uncertainty
            note("failed" if one.name in SCALE_GROUPS and certain else "warning", one.text, _MEASURE)
        elif moved is None:
            if one.rms_px > STRUCTURE_SHARE * min(p.rbe_px for p in fitted.per_camera):
                note("warning", one.text)
        # a misfit that moves points by less than is reported does not mislead
        elif together_mm > fitted_shape_mm and _rms(moved) >= least_mm:
            note("warning", f"{one.text} The shape is off by {1e3 * together_mm:.2g} um for it.")
    if unseen_scale is not None and level == "good":
        scale, shift_mm = unseen_scale
        if np.hypot(shift_mm, fitted_shape_mm) > UNSEEN_FACTOR * fitted_shape_mm:
            note(
                "good",
                f"A stage whose travel is off by {100.0 * scale:.2g} % would hardly show in these views and move the "
                f"shape by {1e3 * shift_mm:.2g} um; {1e3 * fitted_shape_mm:.2g} um are reported, since "
                f"{100.0 * options.scale_sigma:.2g} % is assumed. State stage_scale_sigma by the stage's certificate, "
                "take views over a longer travel, or add free poses of the tilted target.",
            )
    if dropped:
        note("good", f"Left out of the fit: {', '.join(view.name for view in dropped)}.")
        if len(dropped) > DROPPED_SHARE * (len(views) + len(dropped)):
            note("warning", f"{len(dropped)} of {len(views) + len(dropped)} views had to be left out.")
    for text in remarks:
        note("warning", text)
    reasons = (*(passed if level == "good" else ()), *(text for _, text, _ in found))
    return Verdict(level, reasons, tuple((text, remedy) for this, text, remedy in found if this == "failed"))


def _rms(moved_mm: Float) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(moved_mm**2)))


def _shift_px(view: ViewResult) -> float:
    """Length of the mean residual of a view."""
    return float(np.linalg.norm(np.nanmean(view.residual_px.reshape(-1, 2), axis=0)))


def checks_made(
    *,
    held_out: CheckMeasures | None,
    options: CalibrationOptions,
    moves: Moves,
    aspect_estimated: bool,
    aspect_carried: bool,
    stage_over_pitch: tuple[float, float] | None,
    shape_mm: float,
    unseen: Mapping[str, tuple[float, float]],
) -> tuple[CheckDone, ...]:
    """Return the checks made and not made: a wrong scale or a tilted axis does not always show in residuals.

    ``unseen`` are errors of aspect ratios and of the target that are not in the reported error of the shape,
    ``shape_mm``, with the shifts by them.
    """
    staged = moves != "free"

    def hidden(name: str, what: str, remedy: str) -> tuple[bool, str]:
        """Return True if the reported error has room for an error that may be there, and it in words."""
        amount, shift_mm = unseen[name]
        room = bool(np.hypot(shift_mm, shape_mm) <= UNSEEN_FACTOR * shape_mm)
        reported = "within twice the" if room else "which is not in the"
        text = (
            f"{what} by {100.0 * amount:.2g} % would hardly show in these views and move the shape by "
            f"{1e3 * shift_mm:.2g} um, {reported} reported {1e3 * shape_mm:.2g} um"
        )
        return room, f"{text}." if room else f"{text}: {remedy}."

    checks = [_held_out_done(held_out, staged=staged, in_turn=not options.held_out_mm)]
    if staged:
        checks += [
            CheckDone(
                "positions", True, "Order, sign, unit and spacing of the positions agree with the images' scale."
            ),
            CheckDone("angles", True, "The viewing angles agree with the nominal ones and between the cameras."),
        ]
    if stage_over_pitch is not None:
        off, sigma = stage_over_pitch
        text = f"By the pitch, the stage travels {100.0 * off:+.2f} +- {100.0 * sigma:.2f} % farther than it reads."
        seen = sigma < options.max_shape_uncertainty
        if not seen:
            text += (
                f" A pitch or a stage that is wrong by up to {300.0 * sigma:.2g} % would not show in these views, and "
                "the reported error takes both as declared: measure a known distance with both cameras."
            )
        checks.append(CheckDone("scales", seen, text))
    checks.append(
        CheckDone(
            "known_distance",
            False,
            "A pitch that is wrong by less than the stage shows, or by as much as the stage, leaves no residual: "
            "measure a known distance with both cameras."
            if staged
            else "Free poses have no millimetre but the pitch's: measure a known distance with both cameras.",
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
        text = "The aspect ratio was taken as given"
        if aspect_carried:
            text += f"; {ASPECT_SIGMA:g} of it are in the covariance"
        text += "."
        if ASPECTS in unseen:
            text += f" {hidden(ASPECTS, 'Ratios that are off', 'measure them, or state aspect_sigma')[1]}"
        checks.append(CheckDone("aspect", False, text))
    if UNEQUAL_PITCH in unseen:
        remedy = "measure its sides and diagonals, or add free poses of the tilted target"
        checks.append(
            CheckDone("target_shape", *hidden(UNEQUAL_PITCH, "A target that is stretched or sheared", remedy))
        )
    return tuple(checks)


def _held_out_done(held_out: CheckMeasures | None, *, staged: bool, in_turn: bool) -> CheckDone:
    if held_out is None:
        return CheckDone("held_out", False, f"No {'position' if staged else 'pose'} was held out.")
    parts = []
    where = sorted({round(p, 3) for c in held_out.positions_mm for p in c})
    if where:
        parts.append(f"positions {where} mm{', each left out in turn' if in_turn else ''}")
    frames = sorted({k for c in held_out.frames for k in c})
    if frames:
        parts.append(f"{len(frames)} poses, fitted without them")
    return CheckDone("held_out", True, f"Held-out {' and '.join(parts)}: RBE {held_out.mean.rbe_px:.4f} px.")
