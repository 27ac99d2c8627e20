"""Preparation of the fit: sorted and checked views, predicted uncertainty, refusal of insufficient views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from core.arrays import Float
from core.calibration.checks.positions import PositionCheck, check_positions
from core.calibration.fit.adjust import covariance_of
from core.calibration.fit.model import N_CAMERA, camera_of, collect
from core.calibration.fit.start import start_values
from core.calibration.inputs import (
    CalibrationOptions,
    CalibrationView,
    NominalCamera,
    TargetLike,
    check_view,
    inner_nodes_mm,
    is_held_out,
)
from core.calibration.uncertainty import VolumeUncertainty, volume_uncertainty
from core.cameras.stereo import StereoPair
from core.errors import CalibrationError, CalibrationInputError
from core.names import CAMERAS

EXPECTED_NOISE_PX = 0.005  # of a localiser, for predictions before any residual is known
_SAME_POSITION_MM = 1e-6

Views = list[list[CalibrationView]]


def sort_views(views: Sequence[CalibrationView], target: TargetLike, nominals: Sequence[NominalCamera]) -> Views:
    """Return each camera's views by ascending position, every one checked.

    Raises
    ------
    CalibrationInputError
        The codes of :func:`check_view`.
    """
    per_camera: Views = []
    for name, nominal in zip(CAMERAS, nominals, strict=True):
        own = sorted((v for v in views if v.camera == name), key=lambda v: v.dz_mm)
        for view in own:
            check_view(view, target, nominal)
        per_camera.append(own)
    return per_camera


def split_hold_out(per_camera: Views, options: CalibrationOptions) -> Views:
    """Return the views to fit; raises as :func:`check_hold_out`."""
    check_hold_out([[v.dz_mm for v in own] for own in per_camera], options)
    return [[v for v in own if not is_held_out(v.dz_mm, options)] for own in per_camera]


def check_hold_out(positions_mm: Sequence[Sequence[float]], options: CalibrationOptions) -> None:
    """Check the held-out positions against those taken, per camera.

    Raises
    ------
    CalibrationInputError
        ``view_missing`` where a camera has no view, ``hold_out_unknown`` where a held-out position was not taken,
        ``hold_out_all`` where nothing is left to fit.
    """
    for name, taken in zip(CAMERAS, positions_mm, strict=True):
        if not taken:
            raise CalibrationInputError(
                f"There is no view of {name}.", code="view_missing", remedy="Give views of both cameras.", camera=name
            )
        for held in options.held_out_mm:
            if not any(abs(t - held) <= options.hold_out_tolerance_mm for t in taken):
                raise CalibrationInputError(
                    f"The held-out position {held:+g} mm is not among those of {name}: "
                    f"{', '.join(f'{t:+.3f}' for t in taken)} mm.",
                    code="hold_out_unknown",
                    remedy="Hold out positions at which views were taken.",
                    camera=name,
                )
        if all(is_held_out(t, options) for t in taken):
            raise CalibrationInputError(
                f"Every position of {name} is held out.",
                code="hold_out_all",
                remedy="Leave at least two positions in the fit.",
                camera=name,
            )


def predict_uncertainty(
    views: Sequence[CalibrationView],
    target: TargetLike,
    nominals: Sequence[NominalCamera],
    options: CalibrationOptions | None = None,
    *,
    node_sigma_mm: float = 0.0,
    noise_px: float = EXPECTED_NOISE_PX,
) -> VolumeUncertainty:
    """Predict the uncertainty of a calibration with views at these positions, from nominal values and before any fit.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular`` where they do not determine the parameters.
    """
    options = options or CalibrationOptions()
    fitted = split_hold_out(sort_views(views, target, nominals), options)
    nodes = inner_nodes_mm(target)
    parameters = np.zeros((2, N_CAMERA))
    for c, nominal in enumerate(nominals):
        reference = min(fitted[c], key=lambda v: abs(v.dz_mm))
        parameters[c, :10] = start_values(reference, nodes, nominal, float(np.radians(nominal.angle_deg)))
    covariance = covariance_of(
        parameters,
        nodes.reshape(-1, 2),
        [collect(v) for v in fitted],
        nominals,
        options,
        noise_px=np.full(2, noise_px),
        node_sigma_mm=node_sigma_mm,
    )
    pair = StereoPair(*(camera_of(parameters[c], nominals[c].aspect) for c in range(2)))
    return volume_uncertainty(pair, covariance, target)


def compare_positions(
    per_camera: Views, nodes_mm: Float, nominals: Sequence[NominalCamera]
) -> tuple[PositionCheck, PositionCheck]:
    """Check every camera's positions, held-out ones included, against its images."""
    one, two = (check_positions(own, nodes_mm, n) for own, n in zip(per_camera, nominals, strict=True))
    return one, two


def predict_or_refuse(
    per_camera: Views,
    fitted: Views,
    target: TargetLike,
    nominals: Sequence[NominalCamera],
    options: CalibrationOptions,
    node_sigma_mm: float,
) -> VolumeUncertainty:
    """Predict the uncertainty, and refuse views for which it is too large.

    Raises
    ------
    CalibrationInputError
        ``calibration_one_position`` or ``calibration_dz_too_small``, with the predicted uncertainty.
    """
    everything = [v for own in per_camera for v in own]
    # a declared tilt of the stage axis increases the centre's uncertainty at any travel
    travel_only = replace(options, axis_tilt_sigma_rad=0.0)
    try:
        predicted = predict_uncertainty(everything, target, nominals, travel_only, node_sigma_mm=node_sigma_mm)
        figure = (
            f"{1e3 * predicted.shape_rms_mm:.2f} um rms of shape, {predicted.centre_px:.1f} px of the image centre "
            f"(prior {options.centre_sigma_px:g} px), {100.0 * predicted.standoff_relative:.2f} % of the standoff"
        )
        relative = predicted.relative_shape
    except CalibrationError:
        predicted, figure, relative = None, "without bound", float("inf")
    travels = [max(v.dz_mm for v in own) - min(v.dz_mm for v in own) for own in fitted]
    for name, own, travel in zip(CAMERAS, fitted, travels, strict=True):
        if travel <= _SAME_POSITION_MM:
            views_text = "only one view" if len(own) == 1 else f"{len(own)} views, all"
            raise CalibrationInputError(
                f"{name} has {views_text} at {own[0].dz_mm:+.3f} mm to fit: predicted uncertainty {figure}.",
                code="calibration_one_position",
                predicted_shape=relative,
                camera=name,
            )
    if (
        predicted is None
        or not relative <= options.max_shape_uncertainty
        or not predicted.centre_px <= options.max_centre_sigma_px
        or not predicted.standoff_relative <= options.max_standoff_sigma
    ):
        raise CalibrationInputError(
            f"The fitted positions span only {min(travels):.3f} mm: predicted uncertainty {figure}; the limits are "
            f"{options.max_shape_uncertainty:g} of the target's extent, {options.max_centre_sigma_px:g} px and "
            f"{100.0 * options.max_standoff_sigma:g} %.",
            code="calibration_dz_too_small",
            remedy="Take views at stage positions that lie further apart.",
            predicted_shape=relative,
        )
    return predicted
