"""The calibration of both cameras from the target's intersections."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import Float
from core.calibration.checks.angles import check_angles
from core.calibration.fit.adjust import Adjustment, adjust
from core.calibration.fit.model import N_CAMERA, camera_of, collect
from core.calibration.fit.single import fit_single
from core.calibration.fit.start import start_values
from core.calibration.inputs import CalibrationOptions, CalibrationView, NominalCamera, TargetLike, inner_nodes_mm
from core.calibration.prepare import Views, compare_positions, predict_or_refuse, sort_views, split_hold_out
from core.calibration.report import build_result
from core.calibration.result import CalibrationResult
from core.errors import CalibrationError
from core.names import CAMERAS


def calibrate(
    views: Sequence[CalibrationView],
    target: TargetLike,
    nominals: tuple[NominalCamera, NominalCamera],
    options: CalibrationOptions | None = None,
) -> CalibrationResult:
    """Calibrate a pair of cameras.

    Parameters
    ----------
    views
        Views of both cameras in any order, held-out ones included.
    target
        The grid.
    nominals
        Nominal values of camera 1 and camera 2.
    options
        Settings; see :class:`CalibrationOptions`.

    Returns
    -------
    CalibrationResult
        In the system frame: the target's plane at dZ = 0, origin at its centre.

    Raises
    ------
    CalibrationInputError
        Views that cannot determine the cameras, or that contradict what was declared about them.
    CalibrationError
        No usable minimum.

    References
    ----------
    Helm, McNeill, Sutton (1996), doi:10.1117/1.600624, section 3.2.3, Eqs. (9) to (11), (15) to (17).
    """
    options = options or CalibrationOptions()
    nodes = inner_nodes_mm(target)
    per_camera = sort_views(views, target, nominals)
    fitted = split_hold_out(per_camera, options)
    nodes_estimated = options.estimate_nodes is not False and target.node_tolerance_mm > 0.0
    # a bound of +-t with nothing known inside it has this standard deviation
    node_sigma = target.node_tolerance_mm / float(np.sqrt(3.0)) if nodes_estimated else 0.0

    positions = compare_positions(per_camera, nodes, nominals)
    predicted = predict_or_refuse(per_camera, fitted, target, nominals, options, node_sigma)
    try:
        adjustment = _fit(fitted, nodes, nominals, options, node_sigma)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"The solver failed: {error}.", code="calibration_singular") from error
    return build_result(
        adjustment,
        per_camera,
        target,
        nominals,
        options,
        predicted=predicted,
        positions=positions,
        nodes_estimated=nodes_estimated,
    )


def _fit(
    fitted: Views,
    nodes_mm: Float,
    nominals: tuple[NominalCamera, NominalCamera],
    options: CalibrationOptions,
    node_sigma_mm: float,
) -> Adjustment:
    observations = [collect(own) for own in fitted]
    flat = nodes_mm.reshape(-1, 2)
    parameters = np.zeros((2, N_CAMERA))
    for c, nominal in enumerate(nominals):
        reference = min(fitted[c], key=lambda v: abs(v.dz_mm))
        gamma = float(np.radians(nominal.angle_deg))
        # a plane seen from the other side of its normal is nearly as good a start; trying both reveals exchanged or
        # mirrored cameras
        starts = [start_values(reference, nodes_mm, nominal, g) for g in (gamma, -gamma)]
        parameters[c, :10] = fit_single(observations[c], flat, nominal, starts, centre_sigma_px=options.centre_sigma_px)
    check_angles(
        {name: camera_of(parameters[c], nominals[c].aspect).cam_from_sys.rotation for c, name in enumerate(CAMERAS)},
        dict(zip(CAMERAS, nominals, strict=True)),
    )
    return adjust(parameters, flat, observations, nominals, options, node_sigma_mm=node_sigma_mm)
