"""Result of the adjustment: measures, residuals per view, uncertainty, verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.agreement import share_of_own_poses
from stereorig.core.calibration.checks.measures import CheckMeasures, Measures, mean_of_cameras, measure_points, pooled
from stereorig.core.calibration.checks.positions import PositionCheck
from stereorig.core.calibration.choice.declared import ASPECTS, AXES, POSITIONS, SCALE, SCALE_GROUPS, TURNS
from stereorig.core.calibration.choice.held_out import HeldOutView, held_out_view
from stereorig.core.calibration.choice.lens import Chosen
from stereorig.core.calibration.choice.screening import points_mm
from stereorig.core.calibration.choice.structure import Structure, image_fields
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.fit.layout import camera_of, camera_seeing, direction
from stereorig.core.calibration.fit.named import named_by_cause, named_covariance, named_derivatives, parameter_names
from stereorig.core.calibration.inputs import AnyTarget, CalibrationOptions, NominalValues, flatness_mm
from stereorig.core.calibration.result import CalibrationResult, LensChosen, StageFound, ViewResult
from stereorig.core.calibration.uncertainty import (
    VolumeUncertainty,
    image_derivatives,
    point_derivatives,
    shape_of,
    triangulated,
    volume_uncertainty,
)
from stereorig.core.calibration.verdict import assess, checks_made
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError
from stereorig.core.names import CAMERAS, Cause

UNCERTIFIED_SCALE = 2e-3  # relative error of a travel by a rolled thread, a belt or a rack without certificate
_PER_POSE = 4  # nodes each way of a free pose that represent the volume
_FEW_LOST = 0.05  # share of the points; a lens that has no ray for more of them cannot be the lens of these views


def build_result(
    chosen: Chosen,
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions,
    *,
    predicted: VolumeUncertainty | None,
    positions: tuple[PositionCheck, ...],
    remarks: Sequence[str],
) -> CalibrationResult:
    """Evaluate all views, fitted and held out, under the adjusted cameras; ``remarks`` are warnings of the verdict.

    Raises
    ------
    CalibrationError
        Code ``calibration_not_finite`` if a number that would be stored is not finite.
    """
    adjustment, problem = chosen.screened.adjustment, chosen.screened.problem
    layout, state = adjustment.layout, adjustment.state
    nominal_points = problem.flat_nodes_mm * (1.0 + state.x[layout.pitch_scale])
    points = points_mm(problem, layout, state)
    fitted_views = [
        held_out_view(v, camera_seeing(layout, state, CAMERAS.index(v.camera), v.dz_mm, v.frame), points)
        for v in problem.views
    ]
    fitted_views = [
        HeldOutView(h.view, h.camera, np.where(row.found[:, None], h.xy_px, np.nan))
        for h, row in zip(fitted_views, chosen.screened.rows, strict=True)
    ]
    given = {id(v) for v in problem.views}
    apart = [h for h in chosen.held_out if id(h.view) not in given]
    results = [_view(h, points, held_out=False) for h in fitted_views] + [
        _view(h, points, held_out=True) for h in apart
    ]
    results.sort(key=lambda v: (v.camera, v.dz_mm is None, v.frame if v.dz_mm is None else v.dz_mm))
    fitted = _check(fitted_views, points, nominal_points)
    held_out = _check(chosen.held_out, points, nominal_points) if chosen.held_out else None
    pair = StereoPair(*(camera_of(layout, state.x, c) for c in range(2)))
    names = parameter_names(layout, adjustment.priors)
    covariance = named_covariance(layout, adjustment.priors, state.x, adjustment.covariance)
    by_cause = named_by_cause(layout, adjustment.priors, state.x, adjustment.covariance, adjustment.by_prior)
    volume = None if problem.staged else _points_of_poses(chosen, points)
    uncertainty = fitted_only = volume_uncertainty(pair, covariance, target, names, volume)
    if found := _errors_found(chosen):
        for cause, moment in found.items():
            covariance, by_cause[cause] = covariance + moment, by_cause[cause] + moment
        uncertainty = volume_uncertainty(pair, covariance, target, names, volume)
    free_nodes = adjustment.priors.nodes_free
    corrections = state.nodes_mm[:, :free_nodes].reshape(*problem.nodes_mm.shape[:2], free_nodes)
    finite = (state.x, covariance, adjustment.noise_px, state.nodes_mm, uncertainty.sigma_mm)
    if not all(np.isfinite(part).all() for part in finite) or not np.isfinite(fitted.mean.rbe_px):
        raise CalibrationError("The adjustment ended at numbers that are not finite.", code="calibration_not_finite")
    aspect_estimated = bool(adjustment.priors.free[layout.lens(0)][layout.form.aspect_index])
    verdict = assess(
        fitted=fitted,
        held_out=held_out,
        views=results,
        uncertainty=uncertainty,
        fitted_shape_mm=fitted_only.shape_rms_mm,
        unseen_scale=_unseen_scale(chosen, pair, uncertainty.points_mm),
        # for a target declared exact, the finding itself reports the corrections
        node_corrections_mm=corrections if free_nodes and target.node_tolerance_mm > 0.0 else None,
        node_tolerance_mm=(target.node_tolerance_mm, flatness_mm(target)),
        options=options,
        centres=[(c.lens, n.image_size_px) for c, n in zip((pair.cam1, pair.cam2), nominals, strict=True)],
        structure=[(s, _moved_mm(s, adjustment, pair, nominals, uncertainty.points_mm)) for s in chosen.structure],
        dropped=chosen.screened.dropped,
        staged=bool(problem.staged),
        own_poses=share_of_own_poses(results, points, pair),
        remarks=remarks,
    )
    sigma = np.sqrt(np.maximum(np.diagonal(adjustment.covariance), 0.0))
    return CalibrationResult(
        pair=pair,
        names=names,
        covariance=covariance,
        covariance_by_cause=by_cause,
        lens=LensChosen(chosen.model, chosen.reasons, chosen.structure),
        stage=_stage(adjustment),
        pitch_scale=float(state.x[layout.pitch_scale]),
        pitch_scale_sigma=float(sigma[layout.pitch_scale]),
        dropped=chosen.screened.dropped,
        noise_px=adjustment.noise_px,
        redundancy=adjustment.redundancy,
        axis_tilt_rad=np.stack([state.x[layout.tilt(c)] for c in range(2)]),
        axis_tilt_sigma_rad=np.stack([sigma[layout.tilt(c)] for c in range(2)]),
        node_corrections_mm=corrections if free_nodes else None,
        node_sigma_mm=adjustment.node_sigma_mm.reshape(corrections.shape) if free_nodes else None,
        fitted=fitted,
        held_out=held_out,
        views=tuple(results),
        uncertainty=uncertainty,
        predicted=predicted,
        positions=positions,
        checks=checks_made(
            held_out=held_out,
            options=options,
            moves=problem.moves,
            aspect_estimated=aspect_estimated,
            aspect_carried=bool(adjustment.priors.carried.any()),
            stage_over_pitch=chosen.stage_over_pitch,
            shape_mm=uncertainty.shape_rms_mm,
            unseen=_unseen(chosen, pair, nominals, uncertainty.points_mm),
        ),
        verdict=verdict,
        nominals=nominals,
        options=options,
        iterations=adjustment.iterations,
    )


def _errors_found(chosen: Chosen) -> dict[Cause, Float]:
    """Return second moments of the named parameters' errors by errors of stage and target that the fit lacks, by cause.

    Those of a lens are no errors of parameters alone, and shift the images that are measured, too.
    """
    adjustment = chosen.screened.adjustment
    layout, priors, x = adjustment.layout, adjustment.priors, adjustment.state.x
    D = named_derivatives(layout, priors, x)
    pulled: dict[Cause, Float] = {}
    for found in chosen.structure:
        if found.camera is not None:
            continue
        cause: Cause = "stage" if found.name in (POSITIONS, AXES, TURNS, *SCALE_GROUPS) else "target"
        if found.name in SCALE_GROUPS:
            own = _by_scale(adjustment) * found.terms.get(SCALE, (0.0, 0.0))[0]
        elif found.freed is not None:
            own = found.freed.pulled
        else:
            continue
        pulled[cause] = pulled.get(cause, 0.0) + D @ own
    return {cause: np.outer(own, own) for cause, own in pulled.items()}


def _by_scale(adjustment: Adjustment) -> Float:
    """Return the errors (m,) of the unknowns for a unit of a relative error that all stages' scales have."""
    scales = sorted({adjustment.layout.stage_scale(axis) for axis, _ in adjustment.layout.steps})
    # a fit follows the mean of its priors
    return np.asarray(adjustment.covariance[:, scales] @ adjustment.priors.weight[scales])


def _unseen_scale(chosen: Chosen, pair: StereoPair, points_mm: Float) -> tuple[float, float] | None:
    """Return an error of the stages' scale that the views do not show, and the shape's rms error by it, mm.

    None if the scale is stated, or if nothing moves by a stage.
    """
    adjustment = chosen.screened.adjustment
    if chosen.stage_over_pitch is None or chosen.screened.problem.options.stage_scale_sigma is not None:
        return None
    layout, priors = adjustment.layout, adjustment.priors
    size = float((UNCERTIFIED_SCALE**-2 + chosen.stage_over_pitch[1] ** -2) ** -0.5)
    names = parameter_names(layout, priors)
    moved = point_derivatives(pair, points_mm, names).reshape(-1, len(names)) @ (
        named_derivatives(layout, priors, adjustment.state.x) @ _by_scale(adjustment)
    )
    return size, size * float(np.sqrt(np.mean(shape_of(points_mm, moved[:, None]) ** 2)))


def _unseen(
    chosen: Chosen, pair: StereoPair, nominals: Sequence[NominalValues], points_mm: Float
) -> dict[str, tuple[float, float]]:
    """Return errors that the views do not show and no prior covers, with the shape's rms error by each, mm.

    Of the aspect ratios, unless their uncertainty is stated or in the covariance, and of a stretch and shear of a
    target that was declared exact, by the names of their groups.
    """
    adjustment = chosen.screened.adjustment
    layout, priors = adjustment.layout, adjustment.priors
    names = parameter_names(layout, priors)
    stated = chosen.screened.problem.options.aspect_sigma is not None or bool(priors.carried.any())
    out: dict[str, tuple[float, float]] = {}
    for found in chosen.unseen:
        if found.name == ASPECTS and stated:
            continue
        pulled = named_derivatives(layout, priors, adjustment.state.x) @ found.pulled
        images = -image_derivatives(pair, points_mm, names) @ pulled
        for c, camera in enumerate((pair.cam1, pair.cam2) if found.name == ASPECTS else ()):
            rows = camera.project(points_mm).xy[:, 1] - camera.lens.kernel_parameters()[5]
            images[:, 2 * c + 1, c] += rows / nominals[c].aspect
        moved = shape_of(points_mm, triangulated(pair, points_mm, images).reshape(-1, pulled.shape[1]))
        squares = float(np.einsum("ip,pq,iq->", moved, found.covariance, moved, optimize=True)) / len(moved)
        out[found.name] = float(np.sqrt(np.mean(np.diagonal(found.covariance)))), float(np.sqrt(squares))
    return out


def _moved_mm(
    found: Structure, adjustment: Adjustment, pair: StereoPair, nominals: Sequence[NominalValues], points_mm: Float
) -> Float | None:
    """Return the change (3 n,) of measured points (n, 3) by leaving a structure out of the fit, without a rigid motion.

    The images show its terms, and the fit made up for them as far as its unknowns can. None if it is not known.
    """
    if found.freed is None:
        return None
    layout, priors = adjustment.layout, adjustment.priors
    pulled = named_derivatives(layout, priors, adjustment.state.x) @ found.freed.pulled
    images = -image_derivatives(pair, points_mm, parameter_names(layout, priors)) @ pulled
    for c, (name, camera) in enumerate(zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)):
        if found.camera == name:
            p = camera.cam_from_sys.apply(points_mm)
            fields = image_fields(found, camera.lens, p[:, :2] / p[:, 2:], nominals[c].image_size_px)
            images[:, 2 * c : 2 * c + 2] += fields @ found.freed.values
    return shape_of(points_mm, triangulated(pair, points_mm, images[..., None]).reshape(-1, 1))[:, 0]


def _stage(adjustment: Adjustment) -> StageFound:
    layout, x = adjustment.layout, adjustment.state.x
    sigma = np.sqrt(np.maximum(np.diagonal(adjustment.covariance), 0.0))
    single = layout.moves in ("target", "both_cameras") and bool(layout.steps)
    scales = [layout.stage_scale(axis) for axis in range(2)]
    steps = []
    for axis, dz in layout.steps:
        index = layout.step(axis, dz)
        if index is not None and adjustment.priors.free[index]:
            steps.append((axis, dz, float(x[index]), float(sigma[index])))
    return StageFound(
        moves=layout.moves,
        direction_sys=direction(x[layout.direction]) if single else None,
        direction_sigma_rad=sigma[layout.direction] if single else None,
        scale=x[scales],
        scale_sigma=sigma[scales],
        steps=tuple(steps),
    )


def _points_of_poses(chosen: Chosen, points: Float) -> Float:
    """Some of the target's points in every free pose that both cameras see, system frame."""
    problem, state = chosen.screened.problem, chosen.screened.adjustment.state
    shape = problem.nodes_mm.shape[:2]
    index = np.arange(len(points)).reshape(shape)
    rows, columns = (np.unique(np.linspace(0, n - 1, _PER_POSE).round().astype(int)) for n in shape)
    some = index[np.ix_(rows, columns)].ravel()
    seen = [{v.frame: v for v in problem.views if v.camera == name} for name in CAMERAS]
    out = []
    for frame in sorted(set(seen[0]) & set(seen[1]) - {None}, key=lambda k: -1 if k is None else k):
        found = seen[0][frame].found.ravel() & seen[1][frame].found.ravel()
        own = points[[k for k in some if found[k]] or list(np.flatnonzero(found)[:_PER_POSE])]
        pose = state.sys_from_target.get(frame) if frame is not None else None
        out.append(own if pose is None else pose.apply(own))
    return np.concatenate(out)


def _view(h: HeldOutView, points: Float, *, held_out: bool) -> ViewResult:
    m = _measure(h, points)
    view = h.view
    residual = (h.xy_px - h.camera.project(points).xy).reshape(view.xy_px.shape)
    return ViewResult(
        camera=view.camera,
        dz_mm=view.dz_mm,
        frame=view.frame,
        name=view.label,
        held_out=held_out,
        residual_px=residual,
        rbe_px=m.rbe_px,
        raz_mm=m.raz_mm,
        nsce=m.nsce,
        cam_from_target=h.camera.cam_from_sys,
    )


def _measure(h: HeldOutView, points: Float) -> Measures:
    found = np.isfinite(h.xy_px).all(axis=1)
    return measure_points(h.camera, points[found], h.xy_px[found])


def _seen(views: Sequence[HeldOutView], points: Float) -> list[HeldOutView]:
    """Return the views without the points that their cameras have no ray or image for, unless these are many.

    Views left out of a fit may have points outside the range of the fitted views, where a wide lens has no more rays.
    """
    lost = []
    for h in views:
        with np.errstate(invalid="ignore"):
            known = h.camera.project(points).valid & h.camera.lens.normalised_from_image(h.xy_px).valid
        lost.append(np.isfinite(h.xy_px).all(axis=1) & ~known)
    count = sum(int(np.isfinite(h.xy_px).all(axis=1).sum()) for h in views)
    if sum(int(part.sum()) for part in lost) > _FEW_LOST * count:
        return list(views)
    return [
        h if not part.any() else HeldOutView(h.view, h.camera, np.where(part[:, None], np.nan, h.xy_px))
        for h, part in zip(views, lost, strict=True)
    ]


def _check(views: Sequence[HeldOutView], points: Float, nominal_points: Float) -> CheckMeasures:
    views = _seen(views, points)
    own = [[h for h in views if h.view.camera == name] for name in CAMERAS]

    def measures(c: int, nodes: Float) -> Measures:
        return pooled([_measure(h, nodes) for h in own[c]])

    corrected = measures(0, points), measures(1, points)
    against_nominal = measures(0, nominal_points), measures(1, nominal_points)
    one, two = (tuple(h.view.dz_mm for h in c if h.view.dz_mm is not None) for c in own)
    f1, f2 = (tuple(h.view.frame for h in c if h.view.frame is not None) for c in own)
    return CheckMeasures(
        mean_of_cameras(corrected), corrected, mean_of_cameras(against_nominal), against_nominal, (one, two), (f1, f2)
    )
