"""Result of the adjustment: measures, residuals per view, uncertainty, verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import Float
from core.calibration.checks.measures import CheckMeasures, Measures, mean_of_cameras, measure_points, pooled
from core.calibration.checks.positions import PositionCheck
from core.calibration.fit.adjust import Adjustment
from core.calibration.fit.model import camera_at, camera_of, predicted_residual
from core.calibration.inputs import (
    CalibrationOptions,
    CalibrationView,
    NominalCamera,
    TargetLike,
    inner_nodes_mm,
    is_held_out,
)
from core.calibration.prepare import Views
from core.calibration.result import TEN_OF_BOTH, CalibrationResult, ViewResult
from core.calibration.uncertainty import VolumeUncertainty, volume_uncertainty
from core.calibration.verdict import assess, checks_made
from core.cameras.stereo import StereoPair
from core.errors import CalibrationError


def build_result(
    adjustment: Adjustment,
    per_camera: Views,
    target: TargetLike,
    nominals: tuple[NominalCamera, NominalCamera],
    options: CalibrationOptions,
    *,
    predicted: VolumeUncertainty,
    positions: tuple[PositionCheck, PositionCheck],
    nodes_estimated: bool,
) -> CalibrationResult:
    """Evaluate all views, fitted and held out, under the adjusted cameras.

    Raises
    ------
    CalibrationError
        Code ``calibration_not_finite`` where a number that would be stored is not finite.
    """
    nominal_nodes = inner_nodes_mm(target)
    corrections = adjustment.node_corrections_mm.reshape(nominal_nodes.shape)
    nodes = nominal_nodes + corrections
    results: list[ViewResult] = []
    for c, own in enumerate(per_camera):
        for view in own:
            p, aspect = adjustment.parameters[c], nominals[c].aspect
            m = _measure(p, aspect, nodes, view)
            residual = predicted_residual(p, aspect, nodes, view)
            held = is_held_out(view.dz_mm, options)
            results.append(ViewResult(view.camera, view.dz_mm, view.label, held, residual, m.rbe_px, m.raz_mm, m.nsce))
    fitted = _check(adjustment, per_camera, nodes, nominal_nodes, nominals, options, held_out=False)
    held_out = (
        _check(adjustment, per_camera, nodes, nominal_nodes, nominals, options, held_out=True)
        if options.held_out_mm
        else None
    )
    pair = StereoPair(*(camera_of(adjustment.parameters[c], nominals[c].aspect) for c in range(2)))
    uncertainty = volume_uncertainty(pair, adjustment.covariance, target)
    covariance = adjustment.covariance[np.ix_(TEN_OF_BOTH, TEN_OF_BOTH)]
    sigmas = np.sqrt(np.diagonal(adjustment.covariance)).reshape(2, -1)
    finite = (adjustment.parameters, covariance, adjustment.noise_px, corrections, uncertainty.sigma_mm)
    if not all(np.isfinite(part).all() for part in finite) or not np.isfinite(fitted.mean.rbe_px):
        raise CalibrationError("The adjustment ended at numbers that are not finite.", code="calibration_not_finite")
    verdict = assess(
        fitted=fitted,
        held_out=held_out,
        views=results,
        uncertainty=uncertainty,
        node_corrections_mm=corrections if nodes_estimated else None,
        node_tolerance_mm=target.node_tolerance_mm,
        options=options,
        centres=[
            (camera.paper_parameters(), nominal.image_size_px)
            for camera, nominal in zip((pair.cam1, pair.cam2), nominals, strict=True)
        ],
    )
    return CalibrationResult(
        pair=pair,
        covariance=covariance,
        noise_px=adjustment.noise_px,
        redundancy=adjustment.redundancy,
        axis_tilt_rad=adjustment.parameters[:, 10:],
        axis_tilt_sigma_rad=sigmas[:, 10:],
        node_corrections_mm=corrections if nodes_estimated else None,
        node_sigma_mm=adjustment.node_sigma_mm.reshape(nominal_nodes.shape) if nodes_estimated else None,
        fitted=fitted,
        held_out=held_out,
        views=tuple(results),
        uncertainty=uncertainty,
        predicted=predicted,
        positions=positions,
        checks=checks_made(held_out=held_out, options=options),
        verdict=verdict,
        nominals=nominals,
        options=options,
        iterations=adjustment.iterations,
    )


def _measure(parameters: Float, aspect: float, nodes_mm: Float, view: CalibrationView) -> Measures:
    found = view.found
    points = np.column_stack([nodes_mm[found], np.zeros(int(found.sum()))])
    return measure_points(camera_at(parameters, aspect, view.dz_mm), points, view.xy_px[found])


def _check(
    adjustment: Adjustment,
    per_camera: Views,
    nodes_mm: Float,
    nominal_nodes_mm: Float,
    nominals: Sequence[NominalCamera],
    options: CalibrationOptions,
    *,
    held_out: bool,
) -> CheckMeasures:
    chosen = [[v for v in own if is_held_out(v.dz_mm, options) == held_out] for own in per_camera]

    def measures(c: int, nodes: Float) -> Measures:
        return pooled([_measure(adjustment.parameters[c], nominals[c].aspect, nodes, v) for v in chosen[c]])

    corrected = measures(0, nodes_mm), measures(1, nodes_mm)
    against_nominal = measures(0, nominal_nodes_mm), measures(1, nominal_nodes_mm)
    one, two = (tuple(v.dz_mm for v in own) for own in chosen)
    return CheckMeasures(
        mean_of_cameras(corrected), corrected, mean_of_cameras(against_nominal), against_nominal, (one, two)
    )
