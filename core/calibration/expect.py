"""Expected uncertainty of a planned calibration, from nominal values alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.layout import State, camera_of, camera_seeing
from stereorig.core.calibration.fit.named import named_by_cause, named_covariance, parameter_names
from stereorig.core.calibration.inputs import (
    AnyTarget,
    BoardLike,
    CalibrationOptions,
    CalibrationView,
    NominalValues,
    extent_mm,
    nodes_of,
)
from stereorig.core.calibration.prepare import EXPECTED_NOISE_PX, covariance_at, covariance_parts_at, problem_of
from stereorig.core.calibration.uncertainty import VolumeUncertainty, point_derivatives, volume_uncertainty
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError
from stereorig.core.names import CAMERAS, Cause

LineModel = Literal["straight", "parabola", "local"]
_PER_LINE = {"straight": 2, "parabola": 3}


@dataclass(frozen=True)
class Expectation:
    """Expected uncertainty of a planned calibration.

    Attributes
    ----------
    parameters, sigma
        Nominal value and expected standard deviation by name, as a calibration's covariance names them.
    volume
        Uncertainty of points in the target's volume.
    points_mm, sigma_mm
        (9, 3) the middle of the volume, then its corners, and the standard deviation of X, Y, Z there.
    seen
        For each camera, the share of the inner intersections in the nominal camera's image at the worst position.
    reasons
        Reasons for which :func:`stereorig.core.calibration.calibrate` would refuse such views; empty if it would not.
    pair
        The nominal cameras.
    covariance, by_cause
        (n, n) of ``parameters``, in their order, and its parts by cause, which add up to it.
    """

    parameters: dict[str, float]
    sigma: dict[str, float]
    volume: VolumeUncertainty
    points_mm: Float
    sigma_mm: Float
    seen: tuple[float, float]
    reasons: tuple[str, ...]
    pair: StereoPair
    covariance: Float
    by_cause: Mapping[Cause, Float]


def correlation_of_lines(target: AnyTarget, line_model: LineModel | None) -> float:
    """Observed coordinates per independent one, for intersections computed from whole lines (else 1)."""
    per_line = _PER_LINE.get(line_model or "")
    if per_line is None or isinstance(target, BoardLike):
        return 1.0
    n_a, n_b = nodes_of(target).shape[:2]
    return max(float(2.0 * n_a * n_b / (per_line * (n_a + n_b))), 1.0)


def expect(
    positions_mm: Sequence[float],
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions | None = None,
    *,
    noise_px: float = EXPECTED_NOISE_PX,
    roll_deg: float = 0.0,
    line_model: LineModel | None = None,
) -> Expectation:
    """Predict the uncertainty of a calibration from the positions to be fitted.

    The nominal cameras look at the target's centre; the adjustment's own derivatives and priors at the expected image
    coordinates of the intersections give the covariance.

    Parameters
    ----------
    positions_mm
        dZ of the fitted positions, the same for both cameras.
    target, nominals, options
        As for :func:`stereorig.core.calibration.calibrate`; held-out positions have no effect.
    noise_px
        Standard deviation of an intersection's image coordinate.
    roll_deg
        Turn of the grid in the image (alpha of Eq. 1).
    line_model
        Model of the lines; whole lines give fewer independent coordinates.

    Raises
    ------
    CalibrationInputError
        ``calibration_unseen`` if a camera sees too few intersections.
    CalibrationError
        ``calibration_singular`` if the positions determine nothing.
    """
    options = options or CalibrationOptions()
    nodes = nodes_of(target)
    correlation = correlation_of_lines(target, line_model)
    blank = np.full((*nodes.shape[:2], 2), np.nan)
    views = [
        [CalibrationView(name, float(dz), blank, correlation=correlation) for dz in positions_mm] for name in CAMERAS
    ]
    problem = problem_of(views, target, nominals, options)
    layout = problem.layout("paper")
    x = np.zeros(layout.size)
    for c, nominal in enumerate(nominals):
        standoff, angle = nominal.placed()
        x[layout.lens(c)] = layout.form.start(nominal.phd_px, nominal.centre_px, nominal.aspect)
        x[layout.pose(c)] = np.radians(roll_deg), 0.0, np.radians(angle), 0.0, 0.0, standoff
    state = State(x, {}, np.zeros_like(problem.flat_nodes_mm))
    seen = []
    for c, (name, nominal) in enumerate(zip(CAMERAS, nominals, strict=True)):
        width, height = nominal.image_size_px
        shares = []
        for k, view in enumerate(views[c]):
            image = camera_seeing(layout, state, c, view.dz_mm, None).project(problem.flat_nodes_mm)
            inside = image.valid & (image.xy >= -0.5).all(axis=-1) & (image.xy <= [width - 0.5, height - 0.5]).all(-1)
            shares.append(float(inside.mean()))
            views[c][k] = replace(view, xy_px=np.where(inside[:, None], image.xy, np.nan).reshape(blank.shape))
        seen.append(min(shares))
        if min(shares) < 0.25:
            raise CalibrationInputError(
                f"By its nominal values {name} sees {100 * min(shares):.0f} % of the target's points at "
                f"{positions_mm[int(np.argmin(shares))]:+g} mm.",
                code="calibration_unseen",
                remedy="Check phd_px, standoff_mm and image_size_px of the rig file, or use a target that fits.",
                camera=name,
            )
    problem = problem_of(views, target, nominals, options)
    priors = problem.priors(layout)
    names = parameter_names(layout, priors)
    unknowns, parts = covariance_parts_at(problem, layout, state, noise_px=noise_px)
    covariance = named_covariance(layout, priors, x, unknowns)
    pair = StereoPair(*(camera_of(layout, x, c) for c in range(2)))
    volume = volume_uncertainty(pair, covariance, target, names)
    # a declared tilt of the stage axis makes the centre uncertain at any travel: only the travel's effect is judged
    travel_only = problem_of(views, target, nominals, replace(options, axis_tilt_sigma_rad=0.0, aspect_sigma=0.0))
    held = travel_only.priors(layout)
    travel = named_covariance(layout, held, x, covariance_at(travel_only, layout, state, noise_px=noise_px))
    centre_px = volume_uncertainty(pair, travel, target, parameter_names(layout, held)).centre_px
    points = np.concatenate([np.zeros((1, 3)), _corners(volume.points_mm)])
    G = point_derivatives(pair, points, names)
    spread = np.diagonal(G @ covariance @ np.swapaxes(G, 1, 2), axis1=1, axis2=2)
    values = pair.values()
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    return Expectation(
        parameters={name: values[name] for name in names},
        sigma=dict(zip(names, sigma.tolist(), strict=True)),
        volume=volume,
        points_mm=points,
        sigma_mm=np.sqrt(np.maximum(spread, 0.0)),
        seen=(seen[0], seen[1]),
        reasons=_reasons(volume, centre_px, target, options),
        pair=pair,
        covariance=covariance,
        by_cause=named_by_cause(layout, priors, x, unknowns, parts),
    )


def _corners(points_mm: Float) -> Float:
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    return np.array([[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])])


def _reasons(
    volume: VolumeUncertainty, centre_px: float, target: AnyTarget, options: CalibrationOptions
) -> tuple[str, ...]:
    limits = (
        (
            volume.relative_shape,
            options.max_shape_uncertainty,
            f"Shape would be uncertain by {1e3 * volume.shape_rms_mm:.3g} um rms; allowed are "
            f"{1e3 * options.max_shape_uncertainty * extent_mm(target):.3g} um.",
        ),
        (
            # a single stage's direction is unknown and cannot be separated from the centre
            centre_px if options.moves == "cameras" else 0.0,
            options.max_centre_sigma_px,
            f"An image centre would be uncertain by {centre_px:.3g} px; allowed are "
            f"{options.max_centre_sigma_px:g} px.",
        ),
        (
            volume.standoff_relative,
            options.max_standoff_sigma,
            f"A standoff would be uncertain by {100 * volume.standoff_relative:.3g} %; allowed are "
            f"{100 * options.max_standoff_sigma:g} %.",
        ),
    )
    return tuple(text for value, limit, text in limits if not value <= limit)
