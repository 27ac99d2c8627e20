"""The calibration of both cameras from the target's points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.angles import check_angles, check_order
from stereorig.core.calibration.checks.positions import focus_px
from stereorig.core.calibration.choice.lens import Chosen, choose_lens
from stereorig.core.calibration.choice.pairs import name_exchanged, remark_on_distances
from stereorig.core.calibration.fit.layout import camera_of
from stereorig.core.calibration.inputs import AnyTarget, CalibrationOptions, CalibrationView, NominalValues, nodes_of
from stereorig.core.calibration.prepare import (
    Views,
    check_both,
    compare_positions,
    predict_or_refuse,
    problem_of,
    sort_views,
    split_hold_out,
)
from stereorig.core.calibration.report import build_result
from stereorig.core.calibration.result import CalibrationResult
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS

# share of the image's diagonal; the ordinary prior lets a fit find nearer centres and separate them from a tilt of the
# axis
_FAR_SHARE = 0.5
_SURELY = 5.0  # standard deviations of the point that the images shrink towards


def calibrate(
    views: Sequence[CalibrationView],
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions | None = None,
) -> CalibrationResult:
    """Calibrate a pair of cameras.

    Parameters
    ----------
    views
        Views of both cameras in any order, held-out ones included: at stage positions, of free poses, or both.
    target
        The grid or board.
    nominals
        Nominal values of camera 1 and camera 2.
    options
        Settings; see :class:`CalibrationOptions`.

    Returns
    -------
    CalibrationResult
        In the system frame: the target's plane at dZ = 0, origin at its centre; if all poses are free, the plane of the
        first pose.

    Raises
    ------
    CalibrationInputError
        Views that cannot determine the cameras, or that contradict the declarations.
    CalibrationError
        No usable minimum.

    References
    ----------
    Helm, McNeill, Sutton (1996), doi:10.1117/1.600624, section 3.2.3, Eqs. (9) to (11), (15) to (17); for free poses
    Zhang (2000), doi:10.1109/34.888718.
    """
    options = options or CalibrationOptions()
    per_camera = sort_views(views, target, nominals)
    check_both(per_camera)
    _check_moves(per_camera, options)
    fitted = split_hold_out(per_camera, options)
    positions = compare_positions(per_camera, nodes_of(target), nominals, options)
    predicted = predict_or_refuse(per_camera, fitted, target, nominals, options)
    options, remarks = _with_far_centres(per_camera, nominals, options)
    problem = problem_of(fitted, target, nominals, options)
    kept = {id(v) for own in fitted for v in own}
    held = [v for own in per_camera for v in own if id(v) not in kept]
    try:
        chosen = choose_lens(problem, held)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"The solver failed: {error}.", code="calibration_singular") from error
    angles = _check_cameras(chosen, nominals)
    # wider, if a sensor may be tilted in place of the axes, or if the positions scatter
    taken = chosen.screened.problem.options
    options = replace(
        options, axis_tilt_sigma_rad=taken.axis_tilt_sigma_rad, stage_step_sigma_mm=taken.stage_step_sigma_mm
    )
    result = build_result(chosen, target, nominals, options, predicted=predicted, positions=positions, remarks=remarks)
    checks = tuple(replace(c, text=angles) if c.name == "angles" else c for c in result.checks)
    reasons = (*result.verdict.reasons, *remark_on_distances(result.pair, nominals))
    verdict = replace(result.verdict, reasons=reasons)
    dropped = name_exchanged(result.dropped, per_camera, result.pair)
    return replace(result, checks=checks, verdict=verdict, dropped=dropped)


def _with_far_centres(
    per_camera: Views, nominals: Sequence[NominalValues], options: CalibrationOptions
) -> tuple[CalibrationOptions, list[str]]:
    """Return priors that allow for the image centres which the stage's views show, and remarks on centres far off.

    The views show the sum of the centre's offset and the stage axis' tilt; either may be all of it.
    """
    remarks = []
    for name, own, nominal in zip(CAMERAS, per_camera, nominals, strict=True):
        staged = [v for v in own if v.dz_mm is not None]
        if options.moves != "cameras" or len(staged) < 2:
            continue
        focus, sigma_px = focus_px(staged)
        off_px = float(np.linalg.norm(focus - nominal.centre_px))
        if off_px - _SURELY * sigma_px > _FAR_SHARE * np.hypot(*nominal.image_size_px):
            tilt = off_px / nominal.phd_px
            options = replace(
                options,
                centre_sigma_px=max(options.centre_sigma_px, off_px),
                axis_tilt_sigma_rad=max(options.axis_tilt_sigma_rad, tilt),
            )
            remarks.append(
                f"The images of {name} shrink towards a point {off_px:.0f} px from the image's centre: the principal "
                f"point of {name} is there, since the image is a part of the sensor's, or the stage travels "
                f"{1e3 * tilt:.0f} mrad off the optical axis. Both are in the uncertainty."
            )
    return options, remarks


def _check_moves(per_camera: Sequence[Sequence[CalibrationView]], options: CalibrationOptions) -> None:
    staged = [v for own in per_camera for v in own if v.dz_mm is not None]
    if options.moves == "free" and staged:
        raise CalibrationInputError(
            f"{staged[0].label} names a stage position, but nothing is declared to move by it.",
            code="moves_undeclared",
            remedy='Declare moves = "cameras", "both_cameras" or "target", or name the views by their numbers.',
        )


def _check_cameras(chosen: Chosen, nominals: tuple[NominalValues, NominalValues]) -> str:
    """Check the cameras' directions; return the finding for a stage's views."""
    adjustment = chosen.screened.adjustment
    rotations: dict[str, Float] = {
        name: camera_of(adjustment.layout, adjustment.state.x, c).cam_from_sys.rotation
        for c, name in enumerate(CAMERAS)
    }
    known: dict[str, NominalValues] = dict(zip(CAMERAS, nominals, strict=True))
    if chosen.screened.problem.staged:
        return check_angles(rotations, known)
    check_order(rotations, known)
    return ""
