"""The calibration of both cameras from the target's points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import Float
from core.calibration.checks.angles import check_angles, check_order
from core.calibration.choice.lens import Chosen, choose_lens
from core.calibration.fit.layout import camera_of
from core.calibration.inputs import AnyTarget, CalibrationOptions, CalibrationView, NominalCamera, nodes_of
from core.calibration.prepare import (
    check_both,
    compare_positions,
    predict_or_refuse,
    problem_of,
    sort_views,
    split_hold_out,
)
from core.calibration.report import build_result
from core.calibration.result import CalibrationResult
from core.errors import CalibrationError, CalibrationInputError
from core.names import CAMERAS


def calibrate(
    views: Sequence[CalibrationView],
    target: AnyTarget,
    nominals: tuple[NominalCamera, NominalCamera],
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
        In the system frame: the target's plane at dZ = 0, origin at its centre; where all poses are free, that of the
        first pose.

    Raises
    ------
    CalibrationInputError
        Views that cannot determine the cameras, or that contradict what was declared about them.
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
    problem = problem_of(fitted, target, nominals, options)
    kept = {id(v) for own in fitted for v in own}
    held = [v for own in per_camera for v in own if id(v) not in kept]
    try:
        chosen = choose_lens(problem, held)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"The solver failed: {error}.", code="calibration_singular") from error
    _check_cameras(chosen, nominals)
    return build_result(chosen, target, nominals, options, predicted=predicted, positions=positions)


def _check_moves(per_camera: Sequence[Sequence[CalibrationView]], options: CalibrationOptions) -> None:
    staged = [v for own in per_camera for v in own if v.dz_mm is not None]
    if options.moves == "free" and staged:
        raise CalibrationInputError(
            f"{staged[0].label} names a stage position, but nothing is declared to move by it.",
            code="moves_undeclared",
            remedy='Declare moves = "cameras", "both_cameras" or "target", or name the views by their numbers.',
        )


def _check_cameras(chosen: Chosen, nominals: tuple[NominalCamera, NominalCamera]) -> None:
    adjustment = chosen.screened.adjustment
    rotations: dict[str, Float] = {
        name: camera_of(adjustment.layout, adjustment.state.x, c).cam_from_sys.rotation
        for c, name in enumerate(CAMERAS)
    }
    known: dict[str, NominalCamera] = dict(zip(CAMERAS, nominals, strict=True))
    if chosen.screened.problem.staged:
        check_angles(rotations, known)
    else:
        check_order(rotations, known)
