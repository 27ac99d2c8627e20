"""The simulated boards against OpenCV's own pictures and detectors, brute force and hand-counted numbers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import fsolve

from stereorig.core.boards import BoardTarget
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.sim.boards.pattern import INK, PAPER
from stereorig.sim.boards.poses import transform_of
from stereorig.sim.boards.target import SimTarget
from stereorig.sim.optics.lens import SimLens, core_lens
from stereorig.sim.render import RenderOptions, material_points, render
from stereorig.sim.scene import Scene
from stereorig.sim.truth import truth_at

MIDDLE = 0.5 * (INK + PAPER)
POSE = (18.0, -22.0, 9.0, 3.0, -4.0, 5.0)
LENS = SimLens(fx_px=2006.0, fy_px=1998.0, cx_px=611.3, cy_px=517.8, k1=-0.15, k2=0.06, p1=2e-4, p2=-3e-4, k4=0.02)
CAMERA = Camera(
    core_lens(LENS), RigidTransform(cv2.Rodrigues(np.array([0.02, -0.2, 0.05]))[0], np.array([1.0, -2.0, 200.0]))
)
SIZE = (1224, 1024)


def board(kind: str, size: tuple[int, int] = (9, 6), pitch_mm: float = 8.0, **more: object) -> SimTarget:
    usual = {"marker_mm": 0.7 * pitch_mm} if kind == "charuco" else {}
    return SimTarget(pitch_mm=pitch_mm).changed({"kind": kind, "size": size} | usual | more)


def scene_of(target: SimTarget, pose: tuple[float, ...] = POSE, seed: int = 3) -> Scene:
    return Scene(
        name=target.kind, surface=target.surface(), texture=target.texture(seed), sys_from_body=transform_of(pose)
    )


def opencv_images(points_mm: np.ndarray, pose: tuple[float, ...] = POSE, camera: Camera = CAMERA) -> np.ndarray:
    """Project points of the target's frame by OpenCV alone."""
    turn, shift = cv2.Rodrigues(np.radians(pose[:3]))[0], np.array(pose[3:])
    R, t = camera.cam_from_sys.rotation, camera.cam_from_sys.translation_mm
    K = np.array([[LENS.fx_px, 0.0, LENS.cx_px], [0.0, LENS.fy_px, LENS.cy_px], [0.0, 0.0, 1.0]])
    k = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3, LENS.k4, LENS.k5, LENS.k6])
    flat = points_mm.reshape(-1, 3)
    return cv2.projectPoints(flat, cv2.Rodrigues(R @ turn)[0], R @ shift + t, K, k)[0].reshape(*points_mm.shape[:-1], 2)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_5X5_100", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL"])
@pytest.mark.parametrize("size", [(9, 6), (6, 6), (5, 8)])
def test_a_charuco_board_is_printed_as_opencv_draws_it(dictionary: str, size: tuple[int, int]) -> None:
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = book.markerSize + 2
    marker, scale = float(cells), 10
    pitch = marker + 4.0  # so that every edge of OpenCV's picture lies between two pixels
    texture = board("charuco", size, pitch, marker_mm=marker, dictionary=dictionary).texture(0)
    shape = (size[0] + 1, size[1] + 1)
    drawn = cv2.aruco.CharucoBoard(shape, pitch, marker, book).generateImage(
        (round(shape[0] * pitch * scale), round(shape[1] * pitch * scale)), marginSize=0, borderBits=1
    )
    row, column = np.indices(drawn.shape)
    half = 0.5 * pitch * np.array(shape)
    st = np.stack([(column + 0.5) / scale - half[0], (row + 0.5) / scale - half[1]], axis=-1)
    # beside an edge the texture is soft: sd of a thirteenth of a cell, 0.8 pixels of this picture
    about = cv2.copyMakeBorder(drawn, 8, 8, 8, 8, cv2.BORDER_CONSTANT, value=255)
    away = cv2.morphologyEx(about, cv2.MORPH_GRADIENT, np.ones((11, 11), np.uint8))[8:-8, 8:-8] == 0
    assert away.mean() > 0.2
    value = texture.value(st)
    np.testing.assert_allclose(value[away], np.where(drawn[away] > 127, PAPER, INK), atol=1e-5)
    # and at the edges it is as dark as it is bright
    assert np.abs(value[drawn > 127].mean() - PAPER) < 0.1
    assert np.abs(np.where(drawn > 127, PAPER, INK).mean() - value.mean()) < 2e-3


def test_soft_squares_are_hard_squares_under_a_gaussian() -> None:
    target = board("checkerboard", edge_mm=0.2)
    texture = target.texture(0)
    o = np.linspace(-1.4, 1.4, 1401)
    w = np.exp(-0.5 * (o / 0.2) ** 2)
    w /= w.sum()
    for s, t in ((-32.0 + 0.13, -20.0 - 0.21), (0.05, 4.0), (-40.1, -27.9), (40.2, 3.0)):
        x, y = np.meshgrid(s + o, t + o)
        column, row = np.floor(x / 8.0 + 5.0), np.floor(y / 8.0 + 3.5)
        black = ((row + column) % 2 == 0) & (column >= 0) & (column < 10) & (row >= 0) & (row < 7)
        hard = np.where(black, INK, PAPER)
        # the lattice of 2 um places an edge to half of that: 0.001 / 0.2 / sqrt(2 pi) of the contrast
        assert texture.value([s, t]) == pytest.approx(float(w @ hard @ w), abs=2e-3)


@pytest.mark.parametrize("kind", ["checkerboard", "charuco", "circles", "circles_asymmetric"])
def test_points_lie_where_the_description_of_boards_says(kind: str) -> None:
    target = board(kind, (5, 7), 8.0)
    own = BoardTarget(kind=kind, size=(5, 7), pitch_mm=8.0, marker_mm=5.6 if kind == "charuco" else None)
    np.testing.assert_allclose(np.swapaxes(target.nominal_points_mm(), 0, 1), own.points_mm(), atol=1e-12)
    texture = target.texture(0)
    if kind in ("checkerboard", "charuco"):
        np.testing.assert_allclose(texture.value(target.nominal_points_mm()), MIDDLE, atol=1e-12)
    else:
        np.testing.assert_allclose(texture.value(target.nominal_points_mm()), INK, atol=1e-6)


def test_an_asymmetric_grid_has_the_dots_that_were_counted_by_hand() -> None:
    texture = board("circles_asymmetric", (3, 3), 10.0).texture(0)
    # rows at -10, 0, 10; even rows from -25 in steps of 20, the odd one shifted by 10
    dark = [(-25, -10), (-5, -10), (15, -10), (-15, 0), (5, 0), (25, 0), (-25, 10), (-5, 10), (15, 10)]
    x, y = np.meshgrid(np.arange(-25, 26, 5), np.arange(-10, 11, 5))
    found = {(int(a), int(b)) for a, b in zip(x.ravel(), y.ravel(), strict=True) if texture.value([a, b]) < MIDDLE}
    assert found == set(dark)


def test_the_makers_errors_move_corners_and_dots_and_edges_run_straight_between_them() -> None:
    for kind in ("checkerboard", "charuco"):
        target = board(kind, node_tolerance_mm=0.05)
        texture, points = target.texture(5), target.points_mm(5)[..., :2]
        error = points - target.nominal_points_mm()
        assert 0.045 < np.abs(error).max() <= 0.05
        # cells of the bilinear map meet at the corner: on it a kink of error over pitch, 1 %, of the soft edge
        np.testing.assert_allclose(texture.value(points), MIDDLE, atol=1e-4)
        between = 0.5 * (points[:, 1:] + points[:, :-1])
        np.testing.assert_allclose(texture.value(between), MIDDLE, atol=5e-3)
        # half-way along the ideal edge they miss by up to 0.05 mm, as much as the edge is soft
        assert (
            np.abs(
                texture.value(0.5 * (target.nominal_points_mm()[:, 1:] + target.nominal_points_mm()[:, :-1])) - MIDDLE
            ).max()
            > 0.1
        )
    for kind in ("circles", "circles_asymmetric"):
        target = board(kind, node_tolerance_mm=0.05)
        o = np.linspace(-3.0, 3.0, 241)
        x, y = np.meshgrid(o, o)
        for j, i in ((0, 0), (2, 3), (5, 8)):
            nominal, point = target.nominal_points_mm()[j, i], target.points_mm(5)[j, i, :2]
            ink = PAPER - target.texture(5).value(np.stack([x, y], axis=-1) + nominal)
            centre = np.array([(ink * x).sum(), (ink * y).sum()]) / ink.sum() + nominal
            np.testing.assert_allclose(centre, point, atol=1e-4)
            # area of a disc of half the pitch
            assert ink.sum() * 0.025**2 / (PAPER - INK) == pytest.approx(np.pi * 4.0, rel=1e-3)


def test_three_rings_tell_how_a_grid_of_dots_is_turned() -> None:
    target = board("circles", (9, 9), marks=True)
    points = target.nominal_points_mm()
    hollow = target.texture(0).value(points) > MIDDLE
    assert hollow.sum() == 3
    assert all((np.rot90(hollow, k) != hollow).any() for k in (1, 2, 3))
    np.testing.assert_allclose(target.texture(0).value(points + np.array([1.5, 0.0])), INK, atol=1e-6)


def test_a_board_ends_behind_its_margin() -> None:
    target = board("checkerboard", margin_mm=5.0)
    texture = target.texture(0)
    # squares reach to 40 x 28 mm, the plate to 45 x 33
    assert texture.value([44.5, 0.0]) == pytest.approx(PAPER)
    assert texture.value([0.0, -32.5]) == pytest.approx(PAPER)
    for outside in ([45.5, 0.0], [0.0, 33.5], [500.0, 1.0]):
        assert texture.value(outside) == pytest.approx(0.25)


@pytest.mark.parametrize("kind", ["checkerboard", "charuco", "circles", "circles_asymmetric"])
@pytest.mark.parametrize("bow_mm", [0.0, 0.6])
def test_pixels_of_boards_agree_with_brute_force(kind: str, bow_mm: float) -> None:
    target = board(kind, (5, 7), bow_mm=bow_mm, node_tolerance_mm=0.02)
    scene, blur = scene_of(target), 0.6
    at = opencv_images(target.points_mm(3)[1, 1])
    x0, y0 = (int(v) for v in np.round(at)) if kind in ("checkerboard", "charuco") else (int(at[0]) + 17, int(at[1]))
    window = (x0 - 2, y0 - 2, x0 + 3, y0 + 2)
    image = render(scene, CAMERA, SIZE, window=window, options=RenderOptions(blur_px=blur))
    assert np.ptp(image) > 0.2
    # a dense lattice about each pixel; rays by OpenCV, the surface by bisection
    reach, n = 0.5 + 5.0 * blur, 161
    o = (np.arange(n) + 0.5) / n * 2.0 * reach - reach
    box = (np.arange(400) + 0.5) / 400 - 0.5
    w = np.exp(-((o[:, None] - box) ** 2) / (2.0 * blur**2)).mean(axis=1)
    w /= w.sum()
    K = np.array([[LENS.fx_px, 0.0, LENS.cx_px], [0.0, LENS.fy_px, LENS.cy_px], [0.0, 0.0, 1.0]])
    k = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3, LENS.k4, LENS.k5, LENS.k6])
    to_body = (CAMERA.cam_from_sys @ scene.sys_from_body).inverse()
    half = max(target.half_field_mm())
    for row in range(0, 4, 3):
        for column in range(0, 5, 2):
            px = np.stack(np.meshgrid(window[0] + column + o, window[1] + row + o), axis=-1)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-13)
            ray = cv2.undistortPoints(px.reshape(-1, 1, 2), K, k, criteria=criteria).reshape(-1, 2)
            ray = np.column_stack([ray, np.ones(len(ray))]) @ to_body.rotation.T
            near, far = np.full(len(ray), 100.0), np.full(len(ray), 400.0)
            for _ in range(60):
                depth = 0.5 * (near + far)
                p = to_body.translation_mm + depth[:, None] * ray
                before = p[:, 2] < bow_mm * (p[:, 0] ** 2 + p[:, 1] ** 2) / half**2
                near, far = np.where(before, depth, near), np.where(before, far, depth)
            value = scene.texture.value(p[:, :2]).reshape(n, n)
            # the renderer's lattice leaves 2e-4 of the contrast at a sharp edge
            assert image[row, column] == pytest.approx(float(w @ value @ w), abs=4e-4)


@pytest.mark.parametrize("kind", ["checkerboard", "charuco", "circles", "circles_asymmetric"])
def test_opencv_finds_the_board_where_opencv_projects_it(kind: str) -> None:
    target = board(kind, (5, 7) if kind == "circles_asymmetric" else (9, 6), 6.0, node_tolerance_mm=0.02, bow_mm=0.3)
    pose = (12.0, -15.0, 8.0, 2.0, -3.0, 4.0)
    image = render(scene_of(target, pose), CAMERA, SIZE)
    grey = np.round(255.0 * image).astype(np.uint8)
    true = opencv_images(target.points_mm(3), pose)
    size = target.size
    if kind == "checkerboard":
        found, xy = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_ACCURACY)
        xy = np.asarray(xy)
    elif kind == "charuco":
        book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        drawn = cv2.aruco.CharucoBoard((size[0] + 1, size[1] + 1), 6.0, 4.2, book)
        xy, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(grey)
        found = ids is not None and len(ids) == size[0] * size[1]
        xy = np.asarray(xy).reshape(-1, 2)[np.argsort(np.asarray(ids).ravel())]
    else:
        flag = cv2.CALIB_CB_ASYMMETRIC_GRID if kind == "circles_asymmetric" else cv2.CALIB_CB_SYMMETRIC_GRID
        found, xy = cv2.findCirclesGrid(grey, size, flags=flag)
        xy = np.asarray(xy)
    assert found
    error = xy.reshape(size[1], size[0], 2) - true
    if kind != "charuco":
        turned = xy.reshape(size[1], size[0], 2)[::-1, ::-1] - true
        error = min(error, turned, key=lambda e: float(np.abs(e).max()))
    # OpenCV's corners are right to a tenth of a pixel, its dots are blobs' centroids; in the mean half of that
    assert np.sqrt(np.mean(error**2)) < 0.12
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.06


@pytest.mark.parametrize("bow_mm", [0.0, 0.8, -0.8])
def test_truth_of_a_board_in_a_pose_is_its_plane_or_its_bow(bow_mm: float) -> None:
    target = board("checkerboard", bow_mm=bow_mm)
    scene = scene_of(target)
    px = opencv_images(target.points_mm(3)[::2, ::3])
    truth = truth_at(scene, CAMERA, px)
    points = target.points_mm(3)[::2, ::3]
    # Newton and OpenCV's projection are exact to 1e-10 px, which are 1e-11 mm here
    np.testing.assert_allclose(truth.st_mm, points[..., :2], atol=1e-8)
    np.testing.assert_allclose(truth.xyz_mm, transform_of(POSE).apply(points), atol=1e-8)
    c = bow_mm / 32.0**2
    body = np.stack([-2 * c * points[..., 0], -2 * c * points[..., 1], np.ones(points.shape[:-1])], axis=-1)
    body /= np.linalg.norm(body, axis=-1, keepdims=True)
    np.testing.assert_allclose(truth.normal_sys, body @ transform_of(POSE).rotation.T, atol=1e-8)
    # a pixel between: the ray's meeting with the surface by a general solver

    def miss(st: np.ndarray) -> np.ndarray:
        z = c * (st[0] ** 2 + st[1] ** 2)
        return opencv_images(np.array([st[0], st[1], z])) - [700.0, 450.0]

    np.testing.assert_allclose(material_points(scene, CAMERA, [700.0, 450.0])[0], fsolve(miss, [1.0, 1.0]), atol=1e-6)


def test_a_target_that_makes_no_sense_is_refused() -> None:
    for change, word in (
        ({"kind": "tomato"}, "kind"),
        ({"kind": "checkerboard", "size": (2, 6)}, "size"),
        ({"kind": "checkerboard", "size": (2000, 6)}, "size"),
        ({"kind": "charuco", "size": (9, 6), "marker_mm": 9.0}, "marker_mm"),
        ({"kind": "circles", "size": (9, 6), "node_tolerance_mm": 3.0}, "node_tolerance_mm"),
        ({"kind": "circles", "size": (9, 6), "bow_mm": float("nan")}, "bow_mm"),
        ({"kind": "circles", "size": (9, 6), "pitch_error": 0.5}, "pitch_error"),
        ({"lines": (100_000, 100_000), "line_width_mm": 0.1}, "lines"),
        ({"pitch_mm": 1e-300, "kind": "circles", "size": (9, 6)}, "pitch_mm"),
        ({"colour": 3}, "colour"),
    ):
        with pytest.raises(ValueError, match=word):
            SimTarget(pitch_mm=8.0).changed(change)
    for more, word in (
        ({"dictionary": "DICT_9X9"}, "dictionary"),
        ({"dictionary": "DICT_4X4_50", "size": (15, 15)}, "50 markers"),
        ({"edge_mm": 3.0}, "edge_mm"),
        ({"margin_mm": -1.0}, "margin_mm"),
    ):
        with pytest.raises(ValueError, match=word):
            board("charuco", **more).texture(0)
    with pytest.raises(ValueError, match="do not fit"):
        board("circles", dot_mm=8.0).texture(0)
