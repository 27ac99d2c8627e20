"""Status of points that growth did not reach because their patch leaves an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.volume import CalibratedVolume
from stereorig.core.errors import RegionError
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import move_matrix, move_w
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.blur import Blur
from stereorig.core.status import PointStatus

_REACH_SUBSETS = 4.0
_UNKNOWN = 0.05  # share of the distance that a patch is extended by: possible change of the motion there


def mark_outside(fitter: Fitter, points: PointFits, xy_px: Float, usable: Bool, *, however_far: bool = False) -> None:
    """Give unreached points the status OUTSIDE_IMAGE if the nearest valid patch, extended, leaves an image.

    Parameters
    ----------
    fitter
        The matcher with its images.
    points
        (n) points, changed in place.
    xy_px, usable
        (n, 2) px of camera 1, and (n,) True where a point may be measured.
    however_far
        Points at any distance from the nearest valid one, for which nothing is searched any more, where a twentieth of
        that distance does not bring them back; else those within some subsets of it.
    """
    open_ = np.flatnonzero(usable & (points.status == PointStatus.NOT_SEEDED))
    valid = np.flatnonzero(points.ok)
    if len(open_) == 0 or len(valid) == 0:
        return
    subset = fitter.options.subset_px
    distance, nearest = cKDTree(xy_px[valid]).query(xy_px[open_])
    near = np.asarray(distance) < _REACH_SUBSETS * subset
    if however_far:
        margin_px, near = np.where(near, 0.0, -_UNKNOWN * distance)[:, None], np.ones_like(near)
    else:
        margin_px = np.zeros((int(near.sum()), 1))
    open_, parent = open_[near], valid[np.asarray(nearest)[near]]
    outside = leaves_an_image(fitter, xy_px[open_], xy_px[parent], points.take(parent), margin_px)
    points.status[open_[outside]] = PointStatus.OUTSIDE_IMAGE


def leaves_an_image(
    fitter: Fitter, xy_px: Float, from_px: Float, patches: PointFits, margin_px: float | Float = 0.0
) -> Bool:
    """Return (n,) True where a subset on the extended patch of another point leaves an image.

    Parameters
    ----------
    fitter
        The matcher with its images.
    xy_px, from_px
        (n, 2) px of camera 1: the subsets' centres and the patches' own.
    patches
        (n) valid fits.
    margin_px
        Distance from the images' borders that they must keep: of all, or (n, 1) of each.
    """
    outside = np.zeros(len(xy_px), bool)
    half = fitter.options.subset_px // 2
    centre = fitter.pair.cam1.rays_cam(from_px).xyz_mm
    for corner in ((-half, -half), (half, -half), (-half, half), (half, half)):
        ray = fitter.pair.cam1.rays_cam(xy_px + corner).xyz_mm
        offset = ray[:, :2] - centre[:, :2]
        w = move_w(patches.w, offset)[:, :1]
        G = None if fitter.cur1 is None else move_matrix(patches.G, offset)
        outside |= _outside(fitter, ray / w, None if G is None else G[:, :, 0] / w, margin_px)
    return outside


def _outside(fitter: Fitter, before: Float, now: Float | None, margin_px: float | Float) -> Bool:
    """Return (n,) True if a point (n, 3), camera 1's frame, is outside an image or too near to its border."""
    pose, lens1, lens2 = fitter.pair.cam2_from_cam1, fitter.pair.cam1.lens, fitter.pair.cam2.lens
    views = [(pose.apply(before), lens2, fitter.ref2.shape)]
    if now is not None:
        views += [(now, lens1, fitter.ref1.shape), (pose.apply(now), lens2, fitter.ref2.shape)]
    out = np.zeros(len(before), bool)
    for p, lens, (rows, cols) in views:
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = lens.image_from_normalised(p[:, :2] / p[:, 2:]).xy
            last = np.array([cols, rows]) - 1 - margin_px
            inside = (p[:, 2] > 0) & ((xy >= margin_px) & (xy <= last)).all(axis=1)
        out |= ~inside
    return out


# Points near the images' edges, where a Gaussian prefilter lacks neighbours and mirrors the pixels that it has.


def clear_of_edges(fits_image: Bool, grid: PointGrid, shape: tuple[int, int], subset_px: int, blur: Blur) -> Bool:
    """Return (r, c) True where a subset holds only pixels of camera 1's image that were blurred with true neighbours.

    Raises
    ------
    RegionError
        ``region_too_small`` if no point is left.
    """
    margin = subset_px // 2 + blur.edge_px
    rows, cols = shape
    x, y = grid.x_px, grid.y_px
    clear = fits_image & (x >= margin) & (y >= margin) & (x <= cols - 1 - margin) & (y <= rows - 1 - margin)
    if not clear.any():
        raise RegionError(
            f"all points lie nearer than {margin} px to the border of camera 1's image, where the prefilter of "
            f"{blur.sd_px:g} px has no neighbours.",
            code="region_too_small",
            remedy="Give a region further from the image's border, a smaller subset or a smaller prefilter.",
        )
    return np.asarray(clear)


def reject_near_edges(fitter: Fitter, points: PointFits, xy_px: Float, blur: Blur) -> None:
    """Reject points, OUTSIDE_IMAGE, with a patch so near to an image's border that the blur lacks neighbours."""
    ok = np.flatnonzero(points.ok)
    off = leaves_an_image(fitter, xy_px[ok], xy_px[ok], points.take(ok), margin_px=blur.edge_px)
    rejected = np.zeros(len(points.status), bool)
    rejected[ok[off]] = True
    points.reject(rejected, PointStatus.OUTSIDE_IMAGE)


# Points outside the volume in which the cameras were calibrated: flagged.


def mark_extrapolated(field: Field, volume: CalibratedVolume | None) -> Field:
    """Return the field with those points marked that are, or were at the reference, outside the calibrated volume.

    Their status becomes EXTRAPOLATED. The calibration's part of their uncertainty, which grows without bound there, is
    in the field's common factor as everywhere.

    Parameters
    ----------
    field
        As measured. A step's starts and the shape that later steps are measured with are taken from the unmarked field.
    volume
        The calibrated volume; None if not known: nothing is marked.
    """
    if volume is None:
        return field
    outside = field.status == PointStatus.OK
    outside &= ~volume.contains(field.xyz_mm)
    now = None if field.uvw_mm is None else field.xyz_mm + field.uvw_mm
    if now is not None:
        outside |= (field.status == PointStatus.OK) & ~volume.contains(now)
    if not outside.any():
        return field
    status = field.status.copy()
    status[outside] = PointStatus.EXTRAPOLATED
    return replace(field, status=status)
