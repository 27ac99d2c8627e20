"""Comparison of a measured displacement with a model's: maps, regions, verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.rigid import skew
from stereorig.core.model.filtered import ModelField, model_at_points
from stereorig.core.model.placement import Placement, no_overlap
from stereorig.core.model.regions import ChiSquare, Tiles, holm, own_covariance_of_means, tiles_of, whitening
from stereorig.core.model.result import Compared, CompareOptions, ModelComparison, ModelStatus
from stereorig.core.model.strains import compare_strain
from stereorig.core.model.surface import ModelSurface
from stereorig.core.robust import chi_square_tail
from stereorig.core.strain.options import StrainOptions

_FAR = 0.02  # share of the field's size: not on the model
_NEAR = 0.5  # share of the field's size: over the model at another height, not elsewhere
_MIN_POINTS = 10
_MIN_SHARE = 0.05
_TILES = 8  # across the field
_MIN_SUBSETS = 2.0  # a tile is wide


@dataclass(frozen=True, eq=False)
class _Difference:
    """Measured less model at the points: (r, c, 3), own covariance (r, c, 3, 3), common columns (r, c, 3, q)."""

    value: Float
    own: Float
    columns: Float


def compare_with_model(
    field: Field,
    surface: ModelSurface,
    placement: Placement,
    *,
    subset_px: int,
    options: CompareOptions | None = None,
    strain: StrainOptions | None = None,
) -> ModelComparison:
    """Compare a displacement with a model's.

    Parameters
    ----------
    field
        A displacement.
    surface
        The model, in its own frame.
    placement
        The model's placement in the system frame.
    subset_px
        Width of the subset that the field was measured with.
    options
        Defaults to ``CompareOptions()``.
    strain
        How the measured strain was computed; None: strain is not compared.

    Returns
    -------
    Comparison
        Result for all points over the model.

    Raises
    ------
    InputError
        ``comparison_needs_motion`` for a shape; ``model_no_overlap`` if hardly any point is over the model,
        ``model_geometry_differs`` if the points over it are far from its surface.

    Notes
    -----
    With m(x) the model's displacement at the measured position x, G its derivative and p the six errors of the
    placement, of which a point is moved by A p,

        d(U - m) = dU - G dX - (omega x m - G A p).

    dX, dU are the points' own noise, correlated by shared pixels, and their common factor; p comes from the same
    measurement, so that the common columns of both are added before they are squared. Regions' means have one joint
    covariance from all of this, the load's uncertainty and the systematic size among it. The chi-square of all of them
    falls into one part in proportion to the model's displacement, and the rest: a stiffness that is wrong by little
    would be lost among the regions. The third part is the region that fits worst, by the chi-square of its own three
    means times the number of regions. The three are judged together, so that a right model is accepted at least as
    often as asked, and a region is refuted only if the model is; if strain is compared too, each quantity has half of
    the probability of a wrong refusal. Rigid motion is fitted to the means by generalised least squares, and takes six
    degrees of freedom.

    A plane model has no displacement along its normal: the difference is taken along its plane, and the rigid motion is
    a motion in the plane. Strain is along the surface in any case, and is compared as it is.
    """
    options = CompareOptions() if options is None else options
    if field.uvw_mm is None:
        raise InputError(
            "the field is a shape and has no displacement to compare.",
            code="comparison_needs_motion",
            remedy="Give the result of a later step.",
        )
    placed = surface.moved(placement.rotation, placement.shift_mm)
    found = _on_model(field, placed, subset_px, options)
    over, model = found.covered, found.field.uvw_mm
    assert model is not None
    measured, turned = _without_rotation(field, model, over) if options.remove_rigid else (field, np.zeros(3))
    assert measured.uvw_mm is not None
    difference = whole = _difference(measured, model, found, placement)
    judged, seen, whole_model, left_out = options, measured, model, None
    if placed.plane:
        turn, left_out = _into_plane(placement.rotation[:, 2])
        difference = _Difference(whole.value @ turn.T, turn @ whole.own @ turn.T, turn @ whole.columns)
        model, seen = model @ turn.T, replace(measured, uvw_mm=measured.uvw_mm @ turn.T)
        u, v, w = np.sqrt(np.square(turn) @ np.square(options.systematic_mm)).tolist()
        judged = replace(options, systematic_mm=(u, v, w))
    shared = SharedPixels.of(field, subset_px)
    width = max(_MIN_SUBSETS * subset_px, _extent_px(field, over) / _TILES)
    tiles = tiles_of(field, over, width_px=options.tile_px or width)
    load = options.load_uncertainty * model
    mean, covariance = _joint(field, tiles, difference, load, shared, judged)
    modes, rigid = None, None
    if options.remove_rigid:
        centre = field.xyz_mm[over].mean(axis=0)
        modes = np.concatenate([-skew(field.xyz_mm - centre), np.broadcast_to(np.eye(3), (*field.shape, 3, 3))], -1)
        modes = np.where(over[..., None, None], modes, 0.0)
        free = np.eye(6)
        if placed.plane:  # one turn and two shifts are seen in the plane
            free = np.zeros((6, 3))
            free[:3, 0], free[3:, 1:] = placement.rotation[:, 2], turn[turn.any(axis=1)].T
            modes = turn @ modes @ free
        N = tiles.means(modes).reshape(-1, modes.shape[-1])
        fitted, left = _fitted(mean, covariance, N)
        mean, covariance = mean - N @ fitted, left
        difference = replace(difference, value=difference.value - modes @ fitted)
        rigid = free @ fitted + np.concatenate([turned, np.zeros(3)])
    level = (1.0 - options.confidence) / (1 if strain is None else 2)
    assert seen.uvw_mm is not None
    displacement = _judged(seen.uvw_mm, model, difference, load, tiles, mean, covariance, judged, level)
    if left_out is not None:
        displacement = _without(displacement, left_out)
    factor, factor_sigma = _factor(field, tiles, seen, model, difference, shared, judged, modes)
    height = found.distance_mm[over]
    noise = np.einsum("na,nab,nb->n", field.normal_sys[over], field.covariance[over][:, :3, :3], field.normal_sys[over])
    status = np.full(field.shape, np.int8(ModelStatus.NOT_MEASURED))
    status[field.valid] = np.int8(ModelStatus.NO_MODEL)
    status[over] = np.int8(ModelStatus.COMPARED)
    return ModelComparison(
        options=options,
        status=status,
        placement=placement,
        at_points=found,
        tiles=tiles,
        displacement=displacement,
        strain=None
        if strain is None
        else compare_strain(
            measured,
            found.field,
            whole.own,
            np.concatenate([whole.columns, options.load_uncertainty * whole_model[..., None]], -1),
            tiles,
            strain,
            subset_px=subset_px,
            level=level,
        ),
        factor=factor,
        factor_sigma=factor_sigma,
        rigid=rigid,
        shape_rms_mm=float(np.sqrt(np.mean(height**2))),
        shape_ratio=float(np.sqrt(np.mean(height**2 / np.maximum(noise, 1e-18)))),
        left_out=left_out,
    )


def _into_plane(normal: Float) -> tuple[Float, int]:
    """Return M (3, 3) and k: M d is d along a plane, in the axes turned into it by the least; row k is zero."""
    k = int(np.abs(normal).argmax())
    axis = np.zeros(3)
    axis[k] = np.sign(normal[k])
    across = skew(np.cross(normal, axis))
    turn = np.eye(3) + across + across @ across / (1.0 + normal @ axis)
    turn[k] = 0.0
    return turn, k


def _without(one: Compared, k: int) -> Compared:
    """Return a comparison without the numbers of a component that was left out."""

    def unknown(values: Float) -> Float:
        return np.where(np.arange(3) == k, np.nan, values)

    return replace(
        one,
        measured=unknown(one.measured),
        model=unknown(one.model),
        difference=unknown(one.difference),
        sigma=unknown(one.sigma),
        tile_difference=unknown(one.tile_difference),
        tile_sigma=unknown(one.tile_sigma),
    )


def _on_model(field: Field, placed: ModelSurface, subset_px: int, options: CompareOptions) -> ModelField:
    x = field.xyz_mm[field.valid]
    if len(x) < _MIN_POINTS:
        raise no_overlap(field, placed, 0)
    size = float(np.linalg.norm(np.ptp(x, axis=0)))
    far = options.far_mm or _FAR * size
    feet = placed.feet(x, within_mm=max(far, _NEAR * size))
    above = feet.beyond_mm <= far
    if above.sum() < max(_MIN_POINTS, _MIN_SHARE * len(x)):
        raise no_overlap(field, placed, int(above.sum()))
    away = feet.distance_mm[above]
    if np.mean(away > far) > 0.5:
        raise InputError(
            f"The model has another shape: {int((away > far).sum())} of {len(away)} measured points over it are more "
            f"than {far:.3g} mm from its surface, {np.median(away):.3g} mm in the median.",
            code="model_geometry_differs",
            remedy="Check file, unit of length and alignment; a best fit moves the model onto the measured shape.",
        )
    found = model_at_points(field, placed, subset_px=subset_px, far_mm=far)
    if found.covered.sum() < max(_MIN_POINTS, _MIN_SHARE * len(x)):
        raise no_overlap(field, placed, int(found.covered.sum()))
    return found


def _extent_px(field: Field, over: Bool) -> float:
    return float(max(np.ptp(field.x_px[over]), np.ptp(field.y_px[over])))


def _without_rotation(field: Field, model: Float, over: Bool) -> tuple[Field, Float]:
    """Return the field turned back by the rotation that best takes the model's deformed shape to the measured one.

    The remaining rotation is small enough to be linear.
    """
    assert field.uvw_mm is not None
    x = field.xyz_mm[over]
    now, wanted = x + field.uvw_mm[over], x + model[over]
    middle = now.mean(axis=0)
    turn = Rotation.align_vectors(now - middle, wanted - wanted.mean(axis=0))[0]
    R = turn.as_matrix()
    uvw = (field.xyz_mm + field.uvw_mm - middle) @ R + middle - field.xyz_mm
    J = np.block([[np.eye(3), np.zeros((3, 3))], [R.T - np.eye(3), R.T]])
    common = None if field.common is None else J @ field.common
    return replace(
        field, uvw_mm=uvw, covariance=J @ field.covariance @ J.T, common=common, frozen=None
    ), turn.as_rotvec()


def _difference(field: Field, model: Float, found: ModelField, placement: Placement) -> _Difference:
    assert field.uvw_mm is not None
    over = found.covered
    G = np.where(over[..., None, None], found.gradient, 0.0)
    J = np.concatenate([-G, np.broadcast_to(np.eye(3), G.shape)], axis=-1)
    own = np.where(over[..., None, None], J @ field.covariance @ np.swapaxes(J, -1, -2), 0.0)
    # how the six errors of the placement change the difference
    by_placement = G @ placement.moved_by(np.where(over[..., None], field.xyz_mm, 0.0))
    by_placement[..., :3] += skew(np.where(over[..., None], model, 0.0))  # omega x m = -[m] omega
    value, vector = np.linalg.eigh(placement.own)
    columns = [by_placement @ (vector * np.sqrt(np.maximum(value, 0.0)))]
    if field.common is not None:
        shared = J @ field.common
        columns.append(shared if placement.common is None else shared + by_placement @ placement.common)
    both = np.where(over[..., None, None], np.concatenate(columns, axis=-1), 0.0)
    return _Difference(np.where(over[..., None], field.uvw_mm - model, np.nan), own, both)


def _joint(
    field: Field, tiles: Tiles, difference: _Difference, load: Float, shared: SharedPixels, options: CompareOptions
) -> tuple[Float, Float]:
    """Means (3 t,) of the difference over the tiles and their joint covariance."""
    B = tiles.means(np.concatenate([difference.columns, load[..., None]], axis=-1)).reshape(3 * tiles.count, -1)
    covariance = own_covariance_of_means(field, tiles, difference.own, shared) + B @ B.T
    covariance += np.diag(np.tile(np.square(options.systematic_mm), tiles.count))
    return tiles.means(difference.value).ravel(), covariance


def _fitted(mean: Float, covariance: Float, modes: Float) -> tuple[Float, Float]:
    """Amplitudes of modes (3 t, q) by generalised least squares, and the covariance of the remainder."""
    T = whitening(covariance)
    white = T @ modes
    H = np.linalg.inv(white.T @ white)
    return H @ white.T @ (T @ mean), covariance - modes @ H @ modes.T


def _judged(
    measured: Float,
    model: Float,
    difference: _Difference,
    load: Float,
    tiles: Tiles,
    mean: Float,
    covariance: Float,
    options: CompareOptions,
    level: float,
) -> Compared:
    each = tuple(
        ChiSquare.of(mean[3 * k : 3 * k + 3], covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3])
        for k in range(tiles.count)
    )
    overall = ChiSquare.of(mean, covariance)
    scale, pattern = _parts(overall, mean, covariance, tiles.means(np.where(tiles.number[..., None] >= 0, model, 0.0)))
    local = _worst(each)
    parts = [one.probability for one in (scale, pattern, local) if one.degrees]
    # of independent parts, so many exceed the level by chance as often as stated; these parts at most as often
    together = 1.0 - (1.0 - min(parts)) ** len(parts) if parts else np.nan
    over = tiles.number >= 0
    variance = np.diagonal(difference.own, axis1=-2, axis2=-1) + (difference.columns**2).sum(axis=-1)
    variance = variance + np.where(over[..., None], load, 0.0) ** 2 + np.square(options.systematic_mm)
    return Compared(
        measured=np.where(over[..., None], measured, np.nan),
        model=np.where(over[..., None], model, np.nan),
        difference=difference.value,
        sigma=np.where(over[..., None], np.sqrt(variance), np.nan),
        tile_difference=mean.reshape(-1, 3),
        tile_sigma=np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).reshape(-1, 3),
        verdicts=each,
        refuted=holm(np.array([v.probability for v in each]), 1.0 - (1.0 - level) ** (1.0 / max(len(parts), 1))),
        overall=replace(overall, probability=together),
        accepted=not together <= level,
        scale=scale,
        pattern=pattern,
        local=local,
    )


def _worst(each: tuple[ChiSquare, ...]) -> ChiSquare:
    """Return the verdict of the region that fits worst, its probability times their number."""
    known = [v for v in each if v.degrees]
    if not known:
        return ChiSquare(np.nan, 0, np.nan)
    worst = min(known, key=lambda v: v.probability)
    return replace(worst, probability=min(1.0, worst.probability * len(known)))


def _parts(overall: ChiSquare, mean: Float, covariance: Float, model: Float) -> tuple[ChiSquare, ChiSquare]:
    """Split a chi-square into the part in proportion to the model's means (t, 3), and the rest."""
    T = whitening(covariance)
    white = T @ model.ravel()
    size = float(white @ white)
    if not size > 0.0:
        return ChiSquare(0.0, 0, np.nan), overall
    along = float(white @ (T @ mean)) ** 2 / size
    rest, degrees = max(overall.chi_square - along, 0.0), overall.degrees - 1
    return (ChiSquare(along, 1, chi_square_tail(along, 1)), ChiSquare(rest, degrees, chi_square_tail(rest, degrees)))


def _factor(
    field: Field,
    tiles: Tiles,
    measured: Field,
    model: Float,
    difference: _Difference,
    shared: SharedPixels,
    options: CompareOptions,
    modes: Float | None,
) -> tuple[float, float]:
    """The model's factor that fits best, and its standard uncertainty."""
    assert measured.uvw_mm is not None
    over = tiles.number >= 0
    _, covariance = _joint(field, tiles, difference, np.zeros_like(model), shared, options)
    N = tiles.means(np.where(over[..., None], model, 0.0)).reshape(-1, 1)
    if not np.abs(N).max() > 0.0:
        return np.nan, np.nan
    if modes is not None:
        N = np.concatenate([N, tiles.means(modes).reshape(len(N), -1)], axis=1)
    T = whitening(covariance)
    white = T @ N
    H = np.linalg.pinv(white.T @ white, hermitian=True)  # a model that moves rigidly alone has no factor of its own
    seen = T @ tiles.means(np.where(over[..., None], measured.uvw_mm, 0.0)).ravel()
    return float((H @ white.T @ seen)[0]), float(np.sqrt(max(H[0, 0], 0.0)))
