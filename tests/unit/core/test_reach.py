"""Parts of the search for what growth did not reach: depths along the epipolar line, predicted motions, halves."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.seeding.local_search import deeper_range, depth_range, search_shapes, steep_tilts, tilts
from stereorig.core.field.seeding.predicted import local_motion, predicted_motion, seen_elsewhere
from stereorig.core.field.sequence.still_visible import still_visible
from stereorig.core.matching import MatchOptions, prepare
from stereorig.core.status import PointStatus
from tests.support.matching_scene import Plane, Texture, digitise, grid, paper_pair, render, true_g, true_w

PAIR = paper_pair()
XY = grid(count=5)
SUBSET_PX = 21
AFTER = Plane(np.array([0.2, -0.1, 0.15]), np.array([[1.004, 0.03], [-0.03, 1.0], [0.02, -0.01]]))


def tilted(degrees: float, axis: int) -> Plane:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    basis = np.eye(3)[:, :2].copy()
    basis[:, axis] *= c
    basis[2, axis] = s
    return Plane(np.zeros(3), basis)


@lru_cache
def fitter(degrees: float = 0.0, axis: int = 0, moved: bool = False) -> tuple[Fitter, Plane]:
    texture, rng = Texture(blob_mm=0.07), np.random.default_rng(3)
    plane = tilted(degrees, axis)
    planes = (plane, AFTER) if moved else (plane,)
    images = [
        prepare(digitise(render(camera, p, texture), noise=2.0, rng=rng).astype(np.float32))
        for p in planes
        for camera in (PAIR.cam1, PAIR.cam2)
    ]
    more = images[2:] if moved else [None, None]
    return Fitter(PAIR, *images[:2], *more, MatchOptions(subset_px=SUBSET_PX), 0.6), plane


def rays() -> np.ndarray:
    return PAIR.cam1.rays_cam(XY).xyz_mm


@pytest.mark.normal_depth("0.0-0", "40.0-1")
@pytest.mark.parametrize(("degrees", "axis"), [(0.0, 0), (40.0, 0), (40.0, 1), (-45.0, 1)])
def test_a_search_finds_faces_of_any_tilt_from_the_depths_alone(degrees: float, axis: int) -> None:
    matcher, plane = fitter(degrees, axis)
    w = true_w(PAIR.cam1, plane, XY)
    within = depth_range(PAIR, rays(), w[:, 0])
    found = search_shapes(matcher, XY, within, min_zncc=0.8)
    from_truth = matcher.fit(XY, w, None)
    could = from_truth.ok & (from_truth.quality > 0.8)
    assert could.mean() > 0.2
    assert found.ok[could].mean() > 0.8
    off = np.abs(found.w[found.ok, 0] - w[found.ok, 0]) / depth_per_px(PAIR, rays(), w[:, 0])[found.ok]
    assert off.max() < 0.2  # a match elsewhere is pixels off


@pytest.mark.parametrize("degrees", [50.0, 58.0, 65.0])
def test_steep_tilts_come_within_half_a_step_of_every_face_up_to_65_degrees(degrees: float) -> None:
    """Disparity over a subset changes as the slope does: the face's slope, not its angle, must be met."""
    between_rad, subset_px = 0.4, 27
    normals = np.concatenate([tilts(between_rad, subset_px), steep_tilts(between_rad, subset_px)])
    slopes = normals[:, :2] / normals[:, 2:]
    turn = np.linspace(0.0, 2.0 * np.pi, 97)
    faces = np.tan(np.deg2rad(degrees)) * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    nearest = np.linalg.norm(faces[:, None] - slopes[None], axis=-1).min(axis=1)
    disparity_px = nearest * subset_px // 2 * 2.0 * np.tan(0.5 * between_rad)
    assert disparity_px.max() < 1.7  # the refinement finds its way over two


def test_a_part_that_stands_out_by_four_tenths_of_the_fields_width_is_within_the_deeper_range() -> None:
    depth_mm, wide_mm = 300.0, 30.0
    ray = np.array([[x / depth_mm, 0.0, 1.0] for x in np.linspace(-0.5 * wide_mm, 0.5 * wide_mm, 20)])
    found = deeper_range(PAIR, ray, np.full(len(ray), 1.0 / depth_mm))
    assert 1.0 / found.high <= depth_mm - 0.4 * wide_mm
    assert 1.0 / found.low >= depth_mm + 0.4 * wide_mm


def test_a_search_in_an_image_of_something_else_finds_nothing() -> None:
    matcher, plane = fitter()
    other = prepare(
        digitise(
            render(PAIR.cam2, plane, Texture(blob_mm=0.07, seed=9)), noise=2.0, rng=np.random.default_rng(1)
        ).astype(np.float32)
    )
    hidden = Fitter(PAIR, matcher.ref1, other, None, None, matcher.options, 0.6)
    within = depth_range(PAIR, rays(), true_w(PAIR.cam1, plane, XY)[:, 0])
    assert not search_shapes(hidden, XY, within, min_zncc=0.8).ok.any()


@pytest.mark.parametrize(("between_rad", "most"), [(0.2, 25), (0.4, 25), (1.05, 90)])
def test_the_tilts_are_unit_normals_and_finer_between_wide_views(between_rad: float, most: int) -> None:
    normals = tilts(between_rad, SUBSET_PX)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.rad2deg(np.arccos(normals[:, 2])).max() > 50.0
    assert 10 < len(normals) < most  # a search takes its time for each


def some_valid(matcher: Fitter, plane: Plane, known: np.ndarray) -> tuple[PointFits, np.ndarray]:
    points, w = matcher.empty(len(XY)), true_w(PAIR.cam1, plane, XY)
    points.w[known], points.G[known] = w[known], true_g(PAIR.cam1, plane, AFTER, XY)[known]
    points.status[known] = PointStatus.OK
    return points, w


def test_the_motion_of_a_body_is_that_of_its_valid_points() -> None:
    matcher, plane = fitter(moved=True)
    points, w = some_valid(matcher, plane, np.arange(10))
    rest = np.arange(10, len(XY))
    G = local_motion(points, XY, rays(), rest).at(rays()[rest], w[rest])
    where = G[:, :, 0] / w[rest, :1]
    truth = true_g(PAIR.cam1, plane, AFTER, XY)[rest][:, :, 0] / w[rest, :1]
    assert np.abs(where - truth).max() < 1e-3  # mm: the plane is stretched by 0.4 %, the normal is not


def test_points_beyond_a_gap_are_found_where_the_others_say() -> None:
    matcher, plane = fitter(moved=True)
    points, w = some_valid(matcher, plane, np.arange(5))
    rest = np.arange(15, len(XY))
    found = predicted_motion(matcher, points, XY, rays(), rest, w, min_zncc=0.8)
    inside = np.abs(XY[rest] - 80.0).max(axis=1) < 45.0  # they stay in both images
    assert found.ok[inside].all()
    assert not seen_elsewhere(
        matcher, points, XY, rays(), rest, w
    )  # camera 1 shows them there: nothing else to look for


@pytest.mark.parametrize("hidden", [False, True])
def test_a_later_reference_is_worth_its_time_where_both_cameras_show_the_lost_points_again(hidden: bool) -> None:
    texture, rng = Texture(blob_mm=0.07), np.random.default_rng(4)
    cameras, plane = (PAIR.cam1, PAIR.cam2), Plane()

    def taken(at: Plane, texture2: Texture = texture) -> tuple[MeasureImage, MeasureImage]:
        pictures = (render(cameras[0], at, texture), render(cameras[1], at, texture2))
        one, two = (MeasureImage(digitise(p, noise=2.0, rng=rng), "image") for p in pictures)
        return one, two

    rows = (5, 5)
    material = plane.material(PAIR.cam1, XY)
    xyz, moved = plane.position(material), AFTER.position(material)
    lost = np.arange(len(XY)).reshape(rows) >= 10
    everywhere = np.ones(rows, bool)

    def field(uvw: np.ndarray, valid: np.ndarray) -> Field:
        return cast(Field, SimpleNamespace(xyz_mm=xyz.reshape(*rows, 3), uvw_mm=uvw.reshape(*rows, 3), valid=valid))

    found = still_visible(
        PAIR,
        taken(plane),
        taken(AFTER, Texture(blob_mm=0.07, seed=8) if hidden else texture),
        field(np.zeros((len(XY), 3)), everywhere),
        field(moved - xyz, ~lost),
        lost,
        subset_px=SUBSET_PX,
    )
    assert found is not hidden
