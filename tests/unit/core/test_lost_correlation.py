"""A face seen aslant may correlate less than the flat part beside it; a spot in the plane may not."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Bool
from stereorig.core.field.checks.lost_correlation import CorrelationLimits, lost_correlation
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.status import PointStatus
from tests.support.field_bench import grid, pair
from tests.unit.core.test_field_parts import plane_w

GRID = grid()
XY = GRID.xy_px.reshape(-1, 2)
RAYS = pair().cam1.rays_cam(XY).xyz_mm


def lost_of(points: PointFits) -> Bool:
    """Return (n,) True at the points that lose more correlation than their neighbours explain, at the usual limits."""
    return lost_correlation(
        points,
        pair=pair(),
        shape=GRID.shape,
        xy_px=XY,
        rays=RAYS,
        texture=np.full(len(XY), 900.0),
        subset_px=33,
        limits=CorrelationLimits(6.0, 2.0, 6.0),
    )


def test_a_slope_keeps_its_points_and_a_spot_in_the_plane_does_not() -> None:
    rng = np.random.default_rng(4)
    points = PointFits.empty(len(XY), 1)
    points.status[:] = PointStatus.OK
    # the rig's angle is some 60 degrees: the first is seen alike by both cameras, the other at 65 degrees by camera 2
    flat, steep = plane_w(-0.55, 0.0), plane_w(-0.05, 0.0)
    column = np.arange(len(XY)) % GRID.shape[1]
    row = np.arange(len(XY)) // GRID.shape[1]
    face = column >= GRID.shape[1] - 4  # narrower than what it is compared with
    points.w[:] = np.where(face[:, None], steep, flat)
    # of a public pair: 0.998 on flat parts, 0.991 on faces of 45 degrees
    loss = np.where(face, 0.009, 0.002) * np.exp(0.1 * rng.standard_normal(len(XY)))
    spot = (np.abs(column - 8) < 2) & (np.abs(row - 8) < 2)
    loss[spot] *= 15.0  # what loses less is judged by the parts of its subset
    points.zncc[:, 0] = 1.0 - loss
    lost = lost_of(points)
    assert lost[spot].all()
    assert not lost[~spot].any()


def test_what_is_left_where_most_is_lost_is_no_measure_of_what_is_usual() -> None:
    rng = np.random.default_rng(5)
    points = PointFits.empty(len(XY), 3)
    points.status[:] = PointStatus.OK
    points.w[:] = plane_w(0.0, 0.0)
    points.G[:] = 0.0
    points.G[:, :, 0], points.G[:, 0, 1], points.G[:, 1, 2] = RAYS, 1.0, 1.0  # nothing has moved
    # all points lose a hundred times more in time than between the cameras before anything happened
    usual = np.array([0.002, 0.2, 0.2])
    points.zncc[:] = 1.0 - usual * np.exp(0.1 * rng.standard_normal(points.zncc.shape))

    # as a blur does: every point is there, and may
    assert not lost_of(points).any()
    # as another pattern does: most are lost, and what is left shows it, too
    points.status[rng.uniform(size=len(XY)) < 0.6] = PointStatus.NOT_SEEDED
    assert points.ok.sum() > 50
    assert lost_of(points)[points.ok].all()


def test_defocus_by_height_is_no_loss_of_its_crest_though_coarse_texture_scatters_it_and_a_flake_on_it_is() -> None:
    """Coarse speckle scatters the logarithm of what blur takes by 0.23; from 0.2 on the crest was refused."""
    rng = np.random.default_rng(6)
    points = PointFits.empty(len(XY), 3)
    points.status[:] = PointStatus.OK
    points.w[:] = plane_w(0.0, 0.0)
    points.G[:] = 0.0
    points.G[:, :, 0], points.G[:, 0, 1], points.G[:, 1, 2] = RAYS, 1.0, 1.0
    column, row = np.arange(len(XY)) % GRID.shape[1], np.arange(len(XY)) // GRID.shape[1]
    middle = (np.array(GRID.shape[::-1]) - 1) / 2
    away = np.hypot(column - middle[0], row - middle[1]) / middle.min()
    course = 0.001 * np.exp(3.0 * np.exp(-(away**2)))  # twenty times as much on the crest
    loss = course * np.exp(0.23 * rng.standard_normal(len(XY)))
    flake = (np.abs(column - round(middle[0])) < 2) & (np.abs(row - round(middle[1])) < 2)
    for spoiled in (False, True):
        points.zncc[:, 0] = 1.0 - 0.0005
        points.zncc[:, 1:] = 1.0 - np.where(flake & spoiled, 12.0 * course, loss)[:, None]
        lost = lost_of(points)
        assert lost[flake].all() == spoiled
        assert spoiled or not lost.any()
