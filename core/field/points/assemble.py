"""Conversion of the matcher's unknowns at the points into a field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field, Rejected
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.geometry import (
    covariance_xyz,
    covariance_xyzuvw,
    motion_geometry,
    principal_curvatures,
    shape_geometry,
)
from stereorig.core.status import PointStatus

_CLEARLY_LESS = 0.8  # ratio of the shape's variance to the joint estimate's: noise leaves it nearer to one


def _rejected(points: PointFits, pair: StereoPair, grid: PointGrid) -> Rejected | None:
    """Numbers measured at points that a check rejected; None if they are not kept."""
    w, G, epipolar, zncc = (points.rejected_w, points.rejected_g, points.rejected_epipolar_px, points.rejected_zncc)
    if w is None or G is None or epipolar is None or zncc is None:
        return None
    n = len(points.status)
    index = np.flatnonzero(~points.ok & np.isfinite(epipolar) & np.isfinite(w).all(axis=1))
    xy = grid.xy_px.reshape(-1, 2)[index]

    def spread(values: Float) -> Float:
        out = np.full((n, *values.shape[1:]), np.nan)
        out[index] = values
        return out.reshape(*grid.shape, *values.shape[1:])

    motion = zncc.shape[1] == 3
    with np.errstate(invalid="ignore", divide="ignore"):
        xyz = shape_geometry(pair, xy, w[index]).xyz_mm
        uvw = motion_geometry(pair, xy, w[index], G[index]).uvw_mm if motion else None
    return Rejected(spread(xyz), None if uvw is None else spread(uvw), spread(zncc[index]), spread(epipolar[index]))


def patch_degree(points: PointFits, valid: Bool) -> NDArray[np.int8]:
    """Return (r, c) the degree of each valid point's patch, 0 for the others."""
    return np.where(valid, np.where(points.plane.reshape(valid.shape), 1, 2), 0).astype(np.int8)


def assemble(
    points: PointFits,
    *,
    pair: StereoPair,
    grid: PointGrid,
    fits_image: Bool,
    shape: Field | None,
    patch: PatchChoice | None = None,
) -> Field:
    """Return the field in the system frame.

    Parameters
    ----------
    points
        n = rows x columns points.
    pair
        The calibrated cameras.
    grid
        Their positions.
    fits_image
        (r, c) True at allowed points whose subset is inside the image.
    shape
        The reference's shape, whose positions every step repeats; None for a shape.
    patch
        Patch that the points were measured with.
    """
    rows, cols = grid.shape
    motion = points.zncc.shape[1] == 3
    status = points.status.reshape(rows, cols).copy()
    status[~fits_image] = PointStatus.OUTSIDE_IMAGE
    status[~grid.allowed] = PointStatus.MASKED
    valid = status == PointStatus.OK
    index = np.flatnonzero(valid.ravel())
    xy, w, G = grid.xy_px.reshape(-1, 2)[index], points.w[index], points.G[index]

    def spread_over_grid(values: Float, *tail: int) -> Float:
        out = np.full((rows * cols, *tail), np.nan)
        out[index] = values
        return out.reshape(rows, cols, *tail)

    with np.errstate(invalid="ignore", divide="ignore"):
        g = shape_geometry(pair, xy, w)
        xyz = spread_over_grid(g.xyz_mm, 3)
        if motion:
            m = motion_geometry(pair, xy, w, G)
            covariance = spread_over_grid(covariance_xyzuvw(pair, xy, w, G, points.covariance[index]), 6, 6)
        else:
            covariance = spread_over_grid(covariance_xyz(pair, xy, w, points.covariance[index]), 3, 3)
    if shape is not None:
        # a material point's reference position is the same in every step. So is its covariance; that with the
        # displacement stays, since the shape alone is the joint estimate plus an error independent of it
        known = valid & shape.valid
        xyz = np.where(known[..., None], shape.xyz_mm, xyz)
        before, joint = (np.trace(c[..., :3, :3], axis1=-2, axis2=-1) for c in (shape.covariance, covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(known, before / joint, np.nan)
        if known.any() and np.nanquantile(ratio, 0.5) < _CLEARLY_LESS:
            # the residual test has brought the shape's to its scatter, and not the joint estimate's; a position is off
            # along one ray, so that both are one covariance times a number
            change = np.sqrt(np.fmin(ratio, 1.0))[..., None, None]
            covariance[..., :3] *= change
            covariance[..., :3, :] *= change
        larger = known & (before > joint)
        covariance[larger, :3, :3] = shape.covariance[larger][:, :3, :3]
    mixed = motion and w.shape[1] == 6 and bool(points.plane[index].any())
    return Field(
        x_px=grid.x_px,
        y_px=grid.y_px,
        status=status,
        xyz_mm=xyz,
        normal_sys=spread_over_grid(g.normal_sys, 3),
        theta_rad=spread_over_grid(g.theta_rad),
        phi_rad=spread_over_grid(g.phi_rad),
        zp_mm=spread_over_grid(g.zp_mm),
        zncc=spread_over_grid(points.zncc[index], points.zncc.shape[1]),
        epipolar_px=spread_over_grid(points.epipolar_px[index]),
        iterations=np.where(valid, points.iterations.reshape(rows, cols), 0).astype(np.int32),
        noise_grey=spread_over_grid(points.noise[index]),
        covariance=covariance,
        uvw_mm=spread_over_grid(m.uvw_mm, 3) if motion else None,
        rotation_rad=spread_over_grid(m.rotation_rad, 3) if motion else None,
        stretch=spread_over_grid(m.stretch, 3) if motion else None,
        curvature_per_mm=spread_over_grid(principal_curvatures(pair, xy, w), 2)
        if w.shape[1] == 6 and not mixed
        else None,
        patch=patch,
        patch_degree=patch_degree(points, valid) if mixed else None,
        cuts=grid.cuts,
        rejected=_rejected(points, pair, grid),
        starts=Starts(spread_over_grid(w, w.shape[1]), spread_over_grid(G, 3, w.shape[1]) if motion else None),
    )
