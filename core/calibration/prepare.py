"""Preparation of the fit: sorted and checked views, predicted uncertainty, refusal of insufficient views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.positions import PositionCheck, check_positions
from stereorig.core.calibration.fit.adjust import expected_covariance
from stereorig.core.calibration.fit.layout import Layout, State, camera_of
from stereorig.core.calibration.fit.named import named_covariance, parameter_names
from stereorig.core.calibration.fit.problem import FitData, start_pose
from stereorig.core.calibration.inputs import (
    AnyTarget,
    CalibrationOptions,
    CalibrationView,
    NominalValues,
    check_view,
    flatness_mm,
    is_held_out,
    nodes_of,
    pitch_scale_sigma,
)
from stereorig.core.calibration.uncertainty import VolumeUncertainty, volume_uncertainty
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS, Cause

EXPECTED_NOISE_PX = 0.005  # noise of a localiser, for predictions before any residual is known
_SAME_POSITION_MM = 1e-6

Views = list[list[CalibrationView]]


def sort_views(views: Sequence[CalibrationView], target: AnyTarget, nominals: Sequence[NominalValues]) -> Views:
    """Return each camera's views, every one checked: stage positions ascending, then free poses by their numbers.

    Raises
    ------
    CalibrationInputError
        The codes of :func:`check_view`.
    """
    per_camera: Views = []
    for name, nominal in zip(CAMERAS, nominals, strict=True):
        own = [v for v in views if v.camera == name]
        for view in own:
            check_view(view, target, nominal)
        own.sort(key=lambda v: (v.dz_mm is None, v.frame if v.dz_mm is None else v.dz_mm))
        per_camera.append(own)
    return per_camera


def split_hold_out(per_camera: Views, options: CalibrationOptions) -> Views:
    """Return the views to fit; raises as :func:`check_hold_out`."""
    check_hold_out([[v.dz_mm for v in own if v.dz_mm is not None] for own in per_camera], options)
    frames = {v.frame for own in per_camera for v in own}
    for held in options.held_out_frames:
        if held not in frames:
            raise CalibrationInputError(
                f"The held-out pose {held} is not among those taken.",
                code="hold_out_unknown",
                remedy="Hold out poses that were taken, by their numbers.",
            )
    return [[v for v in own if not is_held_out(v.dz_mm, options, v.frame)] for own in per_camera]


def check_hold_out(positions_mm: Sequence[Sequence[float]], options: CalibrationOptions) -> None:
    """Check the held-out positions against those taken, per camera.

    Raises
    ------
    CalibrationInputError
        ``hold_out_unknown`` if a held-out position was not taken, ``hold_out_all`` if no position is left to fit.
    """
    for name, taken in zip(CAMERAS, positions_mm, strict=True):
        for held in options.held_out_mm:
            if not any(abs(t - held) <= options.hold_out_tolerance_mm for t in taken):
                raise CalibrationInputError(
                    f"The held-out position {held:+g} mm is not among those of {name}: "
                    f"{', '.join(f'{t:+.3f}' for t in taken)} mm.",
                    code="hold_out_unknown",
                    remedy="Hold out positions at which views were taken.",
                    camera=name,
                )
        if taken and all(is_held_out(t, options) for t in taken):
            raise CalibrationInputError(
                f"Every position of {name} is held out.",
                code="hold_out_all",
                remedy="Leave at least two positions in the fit.",
                camera=name,
            )


def check_both(per_camera: Sequence[Sequence[object]]) -> None:
    """Raise ``view_missing`` if a camera has no view."""
    for name, own in zip(CAMERAS, per_camera, strict=True):
        if not own:
            raise CalibrationInputError(
                f"There is no view of {name}.", code="view_missing", remedy="Give views of both cameras.", camera=name
            )


def node_sigmas_mm(target: AnyTarget, options: CalibrationOptions, *, free: bool) -> tuple[float, float]:
    """Prior standard deviations of a node's correction, within the target's plane and out of it; 0 holds them.

    A bound of +-t with nothing known inside it has t over the root of three. Out of plane it shows in free poses only.
    """
    if options.estimate_nodes is False or not target.node_tolerance_mm > 0.0:
        return 0.0, 0.0
    within, across = (bound / float(np.sqrt(3.0)) for bound in (target.node_tolerance_mm, flatness_mm(target)))
    return within, across if free else 0.0


def problem_of(
    per_camera: Views, target: AnyTarget, nominals: tuple[NominalValues, NominalValues], options: CalibrationOptions
) -> FitData:
    """Return the problem of fitting these views."""
    views = tuple(v for own in per_camera for v in own)
    free = any(v.frame is not None for v in views)
    staged = any(v.dz_mm is not None for v in views)
    node_sigma_mm = node_sigmas_mm(target, options, free=free)
    # without a stage the scale of a target that errs within a tolerance is found with its other errors as a whole
    as_a_whole = not staged and node_sigma_mm[0] > 0.0 and getattr(target, "pitch_scale_sigma", None) is None
    return FitData(
        views=views,
        nodes_mm=nodes_of(target),
        nominals=nominals,
        options=options,
        moves=options.moves if staged else "free",
        node_sigma_mm=node_sigma_mm,
        pitch_scale_sigma=0.0 if as_a_whole else pitch_scale_sigma(target),
    )


def predict_uncertainty(
    views: Sequence[CalibrationView],
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions | None = None,
) -> VolumeUncertainty:
    """Predict the uncertainty of a calibration with views at these stage positions, from nominal values alone.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular`` if they do not determine the parameters.
    """
    options = options or CalibrationOptions()
    fitted = split_hold_out(sort_views(views, target, nominals), options)
    problem = problem_of(fitted, target, nominals, options)
    layout = problem.layout("paper")
    x = np.zeros(layout.size)
    for c, nominal in enumerate(nominals):
        own = [v for v in fitted[c] if v.dz_mm is not None]
        reference = min(own, key=lambda v: abs(v.position_mm))
        x[layout.lens(c)] = layout.form.start(nominal.phd_px, nominal.centre_px, nominal.aspect)
        x[layout.pose(c)] = start_pose(reference, problem.nodes_mm, nominal, float(np.radians(nominal.placed()[1])))
    return predict_at(problem, layout, x, target, noise_px=EXPECTED_NOISE_PX)


def predict_at(problem: FitData, layout: Layout, x: Float, target: AnyTarget, *, noise_px: float) -> VolumeUncertainty:
    """Predict the uncertainty at given values of the unknowns, without any residual."""
    sigma = covariance_at(problem, layout, State(x, {}, np.zeros_like(problem.flat_nodes_mm)), noise_px=noise_px)
    pair = StereoPair(*(camera_of(layout, x, c) for c in range(2)))
    names, named = (
        parameter_names(layout, problem.priors(layout)),
        named_covariance(layout, problem.priors(layout), x, sigma),
    )
    return volume_uncertainty(pair, named, target, names)


def covariance_at(problem: FitData, layout: Layout, state: State, *, noise_px: float) -> Float:
    """Covariance (m, m) of the unknowns at given values, without any residual: the prediction before measuring.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular``.
    """
    return covariance_parts_at(problem, layout, state, noise_px=noise_px)[0]


def covariance_parts_at(
    problem: FitData, layout: Layout, state: State, *, noise_px: float
) -> tuple[Float, dict[Cause, Float]]:
    """Covariance as :func:`covariance_at`, and its parts, as :func:`.fit.adjust.expected_covariance` returns them.

    Raises
    ------
    CalibrationError
        Code ``calibration_singular``.
    """
    noise = np.full(2, noise_px)
    return expected_covariance(layout, state, problem.rows, problem.flat_nodes_mm, problem.priors(layout), noise)


def compare_positions(
    per_camera: Views, nodes_mm: Float, nominals: Sequence[NominalValues], options: CalibrationOptions
) -> tuple[PositionCheck, ...]:
    """Check every camera's stage positions, held-out ones included, against its images; empty without any."""
    staged = [[v for v in own if v.dz_mm is not None] for own in per_camera]
    if not all(staged):
        return ()
    along_axis = options.moves == "cameras"
    return tuple(
        check_positions(own, nodes_mm, n, along_axis=along_axis) for own, n in zip(staged, nominals, strict=True)
    )


def predict_or_refuse(
    per_camera: Views,
    fitted: Views,
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions,
) -> VolumeUncertainty | None:
    """Predict the uncertainty from the stage's views, and raise an error if it is too large.

    Free poses cannot be predicted from nominal values, and together with them the stage's views need not determine
    everything: with free poses the prediction is None.

    Raises
    ------
    CalibrationInputError
        ``calibration_one_position`` or ``calibration_dz_too_small``, with the predicted uncertainty.
    """
    if any(v.frame is not None for own in per_camera for v in own):
        return None
    everything = [v for own in per_camera for v in own]
    # a declared tilt of the stage axis, or an aspect ratio, increases the centre's uncertainty at any travel
    travel_only = replace(options, axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)
    try:
        predicted = predict_uncertainty(everything, target, nominals, travel_only)
        figure = (
            f"{1e3 * predicted.shape_rms_mm:.2f} um rms of shape, {predicted.centre_px:.1f} px of the image centre "
            f"(prior {options.centre_sigma_px:g} px), {100.0 * predicted.standoff_relative:.2f} % of the standoff"
        )
        relative = predicted.relative_shape
    except CalibrationError:
        predicted, figure, relative = None, "without bound", float("inf")
    positions = [[v.position_mm for v in own if v.dz_mm is not None] for own in fitted]
    travels = [max(own) - min(own) for own in positions]
    for name, own, travel in zip(CAMERAS, positions, travels, strict=True):
        if travel <= _SAME_POSITION_MM:
            views_text = "only one view" if len(own) == 1 else f"{len(own)} views, all"
            raise CalibrationInputError(
                f"{name} has {views_text} at {own[0]:+.3f} mm to fit: predicted uncertainty {figure}.",
                code="calibration_one_position",
                predicted_shape=relative,
                camera=name,
            )
    if (
        predicted is None
        or not relative <= options.max_shape_uncertainty
        # the unknown direction of a single stage is one with the centre, and both cancel in space
        or (options.moves == "cameras" and not predicted.centre_px <= options.max_centre_sigma_px)
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
