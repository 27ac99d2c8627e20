"""Strain of a field of displacements: the surface's metric before and after."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.common.factor import FINE, round_in_place, sample_of
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.strain.common_part import common_part
from stereorig.core.strain.on_surface import OnSurface
from stereorig.core.strain.one_sided import raise_order
from stereorig.core.strain.options import StrainOptions
from stereorig.core.strain.reduced import whole_sums
from stereorig.core.strain.result import StrainField, StrainStatus
from stereorig.core.strain.tensors import strain_of_stretch, strain_slopes
from stereorig.core.strain.window import Slopes, window_slopes

_POINTS_AT_ONCE = 1024  # points whose arrays stay in the processor's cache


def surface_strain(field: Field, options: StrainOptions | None = None, *, subset_px: int) -> StrainField:
    """Return the strain at each point, from a fit over the window about it.

    Reference and deformed positions of the window's points are fitted by the same polynomial in the grid's column and
    row. The slopes of the first give the tangent plane, its frame and the tangents F0 in it; the slopes of the second
    give the same tangents deformed, F1. With B = E^T F0 and E the frame, P = F1 B^-1 is the surface's deformation
    gradient and C = P^T P, free of any rotation.

    Parameters
    ----------
    field
        A displacement on a regular grid; its ``cuts`` and empty points end windows.
    options
        Defaults to ``StrainOptions()``.
    subset_px
        Width of the subset that the field was measured with.

    Returns
    -------
    StrainField
        With the covariance that follows from the points'; neighbours correlate by the pixels that they share.

    Raises
    ------
    InputError
        ``strain_needs_motion`` for a shape.

    Notes
    -----
    A fit over a window measures chords instead of arcs. If the surface keeps its shape this cancels; if it bends from
    flat to a radius R, planes over a window of half width h would have a bias of -h^2 / (10 R^2) (a quarter more with 9
    points in place of a continuum). It is computed from the windows' curvature and subtracted.
    """
    options = StrainOptions() if options is None else options
    if field.uvw_mm is None:
        raise InputError(
            "the field is a shape and has no displacement.",
            code="strain_needs_motion",
            remedy="Give the field of a later step.",
        )
    shared = SharedPixels.of(field, subset_px)
    slopes, surface, left, raised = surface_slopes(field, options, shared)
    status, good = slopes.status, slopes.status == StrainStatus.OK
    area = 1.0 / np.abs(np.linalg.det(surface.per_mm))
    strain = np.full((*field.shape, 3), np.nan)
    covariance = np.full((*field.shape, 3, 3), np.nan)
    strain[good] = surface.strain
    covariance[good] = surface.covariance(slopes.spread[good], options.tensor)
    covariance[..., range(3), range(3)] += left
    surface = replace(surface, around=surface.around[:0].copy())  # the largest array; it has served
    common = None
    if field.common is not None:
        common = _common_part(field, slopes, surface, options)
        typical = np.sqrt(np.median(covariance[good][:, range(3), range(3)], axis=0)) if good.any() else None
        # slopes hold the points' own rounding: finer digits would be noise
        some = np.flatnonzero(good)
        some = some[sample_of(len(some))]
        round_in_place(common, common.reshape(-1, *common.shape[2:])[some], typical, fine=2.0 * FINE)
        common[~good] = np.nan
    spacing_px = _step(field)
    # with smoothed displacements the gauge begins with the width of the smoothing
    gauge_px = (options.window - 1) * spacing_px + shared.reach_px
    return StrainField(
        options=options,
        spacing_px=spacing_px,
        subset_px=subset_px,
        gauge_px=gauge_px,
        gauge_mm=float(gauge_px / spacing_px * np.median(np.sqrt(area))) if good.any() else np.nan,
        status=status,
        strain=strain,
        covariance=covariance,
        patch=_patch_strain(field, options),
        common=common,
        raised=raised,
    )


def _common_part(field: Field, slopes: Slopes, surface: OnSurface, options: StrainOptions) -> Float32:
    """(r, c, 3, k) common factor of the strain: the points' factor through the windows' weights."""
    assert field.common is not None
    good = slopes.status == StrainStatus.OK
    by_slope = np.zeros((*field.shape, 3, 12), np.float32)
    place, flat = np.flatnonzero(good), by_slope.reshape(-1, 3, 12)
    for first in range(0, len(place), _POINTS_AT_ONCE):
        some = slice(first, first + _POINTS_AT_ONCE)
        part = strain_slopes(surface.pulls[some], options.tensor, surface.per_mm[some], surface.strain[some])
        flat[place[some]] = part.reshape(-1, 3, 12)
    return common_part(field.common, field.valid, slopes, by_slope, options.window // 2)


def surface_slopes(
    field: Field, options: StrainOptions, shared: SharedPixels
) -> tuple[Slopes, OnSurface, Float, Bool | None]:
    """Return the windows' fits, and these on the surface.

    Parameters
    ----------
    field
        A displacement.
    options
        Window, order, limits.
    shared
        The correlation of neighbouring points' errors.

    Returns
    -------
    tuple
        :class:`stereorig.core.strain.window.Slopes`; :class:`stereorig.core.strain.one_sided.OnSurface` of the n points
        that have a strain; (r, c, 3) variance that the bias of one-sided planes adds; (r, c) True where quadratics
        replaced them, None unless the order is ``auto``.
    """
    assert field.uvw_mm is not None
    values = np.concatenate([field.xyz_mm, field.uvw_mm], axis=-1)
    xy_px = np.stack([field.x_px, field.y_px], axis=-1)
    slopes = window_slopes(values, field.valid, xy_px, field.cuts, options, shared=shared)
    surface = _on_surface(slopes, field, options)
    if options.order != "auto":
        return slopes, surface, np.zeros((*field.shape, 3)), None
    slopes, left, raised = raise_order(slopes, surface, options.tensor)
    return slopes, _replaced(surface, slopes, field, options, raised), left, raised


def _on_surface(slopes: Slopes, field: Field, options: StrainOptions) -> OnSurface:
    good = slopes.status == StrainStatus.OK
    around = _mean_around(field.covariance, field.valid, options.window, good)
    return _at(good, around, slopes, field, options)


def _replaced(surface: OnSurface, slopes: Slopes, field: Field, options: StrainOptions, raised: Bool) -> OnSurface:
    """Return the surface with the points recomputed, in the same arrays, that quadratics in place of planes changed."""
    good = slopes.status == StrainStatus.OK
    again = raised[good]
    if not again.any():
        return surface
    part = _at(raised & good, surface.around[again], slopes, field, options)
    for f in fields(surface):
        getattr(surface, f.name)[again] = getattr(part, f.name)
    return surface


def _at(good: Bool, around: Float, slopes: Slopes, field: Field, options: StrainOptions) -> OnSurface:
    """Windows' slopes on the surface at the n points ``good``; ``around`` is (n, 6, 6) the mean covariance there."""
    of = slopes.slope[good], slopes.second[good], slopes.moments[good]
    return OnSurface.of(*of, field.normal_sys[good], around, options.tensor)


def surface_frames(tangents: Float, towards: Float) -> Float:
    """Frame (n, 3, 2) of the plane of tangents (n, 3, 2), its normal on the side of ``towards`` (n, 3)."""
    normal = np.cross(tangents[..., 0], tangents[..., 1])
    normal = np.where((normal * towards).sum(-1, keepdims=True) < 0.0, -normal, normal)
    return tangent_frames(normal)[..., :2]


def _mean_around(covariance: Float, valid: Bool, window: int, good: Bool) -> Float:
    """Mean (n, 6, 6) of the valid points' covariance over each window about the points ``good``."""
    ones = np.ones((1, window))
    held = np.where(valid[..., None, None], covariance, 0.0).reshape(*valid.shape, 36)
    total = whole_sums(held, ones, ones, (0,))[good]
    count = whole_sums(valid[..., None].astype(np.float64), ones, ones, (0,))[good]
    return np.asarray((total / count).reshape(-1, 6, 6))


def _patch_strain(field: Field, options: StrainOptions) -> Float | None:
    """Strain (r, c, 3) of each patch itself; None for rigid patches."""
    rigid = field.patch is not None and field.patch.patch == "rigid"
    if rigid or field.stretch is None or field.rotation_rad is None:
        return None
    ok = field.valid
    out = np.full((*field.shape, 3), np.nan)
    out[ok] = strain_of_stretch(field.stretch[ok], field.rotation_rad[ok], field.normal_sys[ok], options.tensor)
    return out


def _step(field: Field) -> float:
    """Distance of neighbouring points, px."""
    x, y = field.x_px, field.y_px
    if x.shape[1] > 1:
        return float(x[0, 1] - x[0, 0])
    return float(y[1, 0] - y[0, 0]) if x.shape[0] > 1 else 1.0
