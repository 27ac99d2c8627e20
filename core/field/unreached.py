"""Points that growth did not reach because their patch lies outside an image: said so, rather than 'not seeded'."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from core.field.fitter import Fitter, PointFits
from core.field.starts import move_matrix, move_w
from core.lens import Bool, Float
from core.status import PointStatus

_REACH_SUBSETS = 4.0


def mark_outside(fitter: Fitter, points: PointFits, xy_px: Float, usable: Bool) -> None:
    """Give unreached points the status OUTSIDE_IMAGE where the nearest standing patch, extended, leaves an image.

    Parameters
    ----------
    fitter
        The matcher with its images.
    points
        (n) points, changed in place.
    xy_px, usable
        (n, 2) and (n,).
    """
    open_ = np.flatnonzero(usable & (points.status == PointStatus.NOT_SEEDED))
    standing = np.flatnonzero(points.ok)
    if len(open_) == 0 or len(standing) == 0:
        return
    subset = fitter.options.subset_px
    distance, nearest = cKDTree(xy_px[standing]).query(xy_px[open_])
    near = np.asarray(distance) < _REACH_SUBSETS * subset
    open_, parent = open_[near], standing[np.asarray(nearest)[near]]
    outside = np.zeros(len(open_), bool)
    half = subset // 2
    centre = fitter.pair.cam1.rays_cam(xy_px[parent]).xyz_mm
    for corner in ((-half, -half), (half, -half), (-half, half), (half, half)):
        ray = fitter.pair.cam1.rays_cam(xy_px[open_] + corner).xyz_mm
        offset = ray[:, :2] - centre[:, :2]
        w = move_w(points.w[parent], offset)[:, :1]
        G = None if fitter.cur1 is None else move_matrix(points.G[parent], offset)
        outside |= _outside(fitter, ray / w, None if G is None else G[:, :, 0] / w)
    points.status[open_[outside]] = PointStatus.OUTSIDE_IMAGE


def _outside(fitter: Fitter, before: Float, now: Float | None) -> Bool:
    """Return (n,) whether a point (n, 3) of camera 1's frame leaves an image at t0 or at t."""
    pose, lens1, lens2 = fitter.pair.cam2_from_cam1, fitter.pair.cam1.lens, fitter.pair.cam2.lens
    views = [(pose.apply(before), lens2, fitter.ref2.shape)]
    if now is not None:
        views += [(now, lens1, fitter.ref1.shape), (pose.apply(now), lens2, fitter.ref2.shape)]
    out = np.zeros(len(before), bool)
    for p, lens, (rows, cols) in views:
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = lens.image_from_normalised(p[:, :2] / p[:, 2:]).xy
            inside = (p[:, 2] > 0) & (xy[:, 0] >= 0) & (xy[:, 1] >= 0) & (xy[:, 0] <= cols - 1) & (xy[:, 1] <= rows - 1)
        out |= ~inside
    return out
