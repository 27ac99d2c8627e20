"""The camera model against formulas written independently, and against OpenCV."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import POSE_NAMES, Camera, RigidTransform, angles_from_rotation, rotation_from_angles
from stereorig.core.cameras.lens import LensModel, OpenCVLens, SeidelLens
from stereorig.core.cameras.stereo import StereoPair

SEIDEL = SeidelLens(12000.0, 255.0, 241.0, 3e-8, 0.9617)
OPENCV = OpenCVLens(6638.0, 6640.0, 981.0, 610.0, 0.4, 0.0889, -2.84, 1e-3, -2e-3, 55.9)
# a wide lens: a quotient that a polynomial in r^2 does not reach, 100 degrees across 2000 px
RATIONAL = OpenCVLens(
    820.0, 823.0, 981.0, 610.0, 0.4, k1=0.62, k2=0.21, p1=1e-3, p2=-2e-3, k3=0.012, k4=0.94, k5=0.38, k6=0.05
)


def opencv_matrix(lens: OpenCVLens) -> Float:
    return np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])


def opencv_coefficients(lens: OpenCVLens) -> Float:
    return np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6])


def paper_camera(gamma: float = 0.5) -> Camera:
    return Camera.from_paper(
        phd_px=12000.0,
        cx_px=255.0,
        cy_px=241.0,
        kappa_per_px2=3e-8,
        aspect=0.9617,
        alpha_rad=0.8,
        beta_rad=0.02,
        gamma_rad=gamma,
        x0_mm=0.3,
        y0_mm=-0.2,
        z0_mm=400.0,
    )


def test_rotation_is_the_papers_matrix() -> None:
    a, b, g = 0.8, -0.1, 0.5
    sa, ca, sb, cb, sg, cg = np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.sin(g), np.cos(g)
    printed = [
        [ca * cg, -sa * cg, sg],
        [sa * cb + ca * sg * sb, ca * cb - sa * sg * sb, -cg * sb],
        [sa * sb - ca * sg * cb, ca * sb + sa * sg * cb, cg * cb],
    ]
    np.testing.assert_allclose(rotation_from_angles(a, b, g), printed, atol=1e-15)
    np.testing.assert_allclose(angles_from_rotation(printed), (a, b, g), atol=1e-14)


def test_projection_by_hand() -> None:
    camera = paper_camera()
    point = np.array([2.0, -1.5, 0.4])
    R = rotation_from_angles(0.8, 0.02, 0.5)
    X, Y, Z = R @ point + [0.3, -0.2, 400.0 + 5.0]
    xs, ys = 12000 * X / Z, 12000 * Y / Z
    d = 1 + 3e-8 * (xs**2 + ys**2)
    got = camera.moved(5.0).project(point)
    np.testing.assert_allclose(got.xy, [xs / d + 255.0, 0.9617 * ys / d + 241.0], rtol=1e-14)
    assert got.valid


def test_opencv_lens_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-40, 40, (50, 2)), rng.uniform(380, 420, 50)])
    lens = OpenCVLens(6638.0, 6640.0, 981.0, 610.0, 0.0, 0.0889, -2.84, 1e-3, -2e-3, 55.9)
    K = np.array([[6638.0, 0, 981.0], [0, 6640.0, 610.0], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([0.0889, -2.84, 1e-3, -2e-3, 55.9]))
    ours = Camera(lens, RigidTransform.identity()).project(points)
    np.testing.assert_allclose(ours.xy, theirs[:, 0], atol=1e-9)


def test_rational_lens_agrees_with_opencv_both_ways() -> None:
    lens = replace(RATIONAL, skew_px=0.0)  # OpenCV has no skew
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 25), np.linspace(-0.75, 0.75, 17))
    n = np.stack([x.ravel(), y.ravel()], -1)
    points = np.column_stack([n, np.ones(len(n))]) * 400.0
    K, d = opencv_matrix(lens), opencv_coefficients(lens)
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, d)[0][:, 0]
    ours = Camera(lens, RigidTransform.identity()).project(points)
    assert ours.valid.all()
    np.testing.assert_allclose(ours.xy, theirs, atol=1e-9)
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-13)
    back = cv2.undistortPoints(theirs[:, None], K, d, criteria=settled)[:, 0]
    np.testing.assert_allclose(lens.normalised_from_image(theirs).xy, back, atol=1e-9)


@pytest.mark.parametrize(
    "lens",
    [
        OpenCVLens(800.0, 800.0, 0.0, 0.0, k4=1.0),  # r / (1 + r^2) turns back at 1
        OpenCVLens(800.0, 800.0, 0.0, 0.0, k4=-0.5),  # r / (1 - r^2 / 2) has a pole at sqrt 2
        OpenCVLens(800.0, 800.0, 0.0, 0.0, k1=1.0, k4=-0.5),
        OpenCVLens(800.0, 800.0, 0.0, 0.0, k1=2.0, k2=1.5, k4=2.4, k5=2.3, k6=0.4),
        OpenCVLens(800.0, 800.0, 0.0, 0.0, k1=9.0, k2=5.0, k4=9.5, k5=9.0),
    ],
)
def test_rational_lens_ends_where_the_radius_stops_growing_and_inverts_up_to_there(lens: OpenCVLens) -> None:
    # brute force: walk outwards until OpenCV's radius falls or jumps to the other side
    r = np.linspace(0.0, 3.0, 30001)
    points = np.column_stack([r, np.zeros_like(r), np.ones_like(r)])
    bent = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), opencv_coefficients(lens))[0][:, 0, 0]
    falls = np.flatnonzero(np.diff(bent) <= 0.0)
    end = r[falls[0]] if len(falls) else np.inf
    valid = lens.image_from_normalised(points[:, :2]).valid
    assert (valid == (r < end + 1e-12))[np.abs(r - end) > 2e-4].all()
    # the inverse stays on the branch that contains the centre; next to a fold or pole a rounding is magnified
    use = r < 0.99 * end
    for angle in (0.0, 1.0, 2.5):
        turn = np.array([np.cos(angle), np.sin(angle)])
        back = lens.normalised_from_image(800.0 * bent[use, None] * turn)
        assert back.valid.all()
        np.testing.assert_allclose(back.xy, r[use, None] * turn, atol=1e-9)
    if len(falls) and np.isfinite(bent).all() and bent.max() < 1.0:
        assert not lens.normalised_from_image([800.0 * 1.001 * bent[r <= end].max(), 0.0]).valid


@pytest.mark.parametrize("lens", [SEIDEL, OPENCV, RATIONAL], ids=["seidel", "opencv", "rational"])
def test_lens_inverts_itself(lens: LensModel) -> None:
    assert isinstance(lens, LensModel)
    x, y = np.meshgrid(np.linspace(-200, 2000, 23), np.linspace(-200, 1400, 19))
    xy = np.stack([x, y], -1)
    n = lens.normalised_from_image(xy)
    assert n.valid.all()
    back = lens.image_from_normalised(n.xy)
    np.testing.assert_allclose(back.xy, xy, atol=1e-8)


@pytest.mark.parametrize("lens", [SEIDEL, OPENCV, RATIONAL], ids=["seidel", "opencv", "rational"])
def test_lens_jacobians_match_differences(lens: LensModel) -> None:
    n = np.random.default_rng(2).uniform(-0.1, 0.1, (20, 2))
    h = 1e-6
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = h
        difference = (lens.image_from_normalised(n + step).xy - lens.image_from_normalised(n - step).xy) / (2 * h)
        np.testing.assert_allclose(lens.image_jacobian(n)[..., axis], difference, rtol=1e-6, atol=1e-5)
    jac = lens.parameter_jacobian(n)
    fields = {k: getattr(lens, k) for k in lens.parameter_names}
    for i, name in enumerate(lens.parameter_names):
        h_p = max(abs(fields[name]), 1e-9) * 1e-5 if name == "kappa_per_px2" else 1e-5
        up = type(lens)(**{**fields, name: fields[name] + h_p}).image_from_normalised(n).xy
        down = type(lens)(**{**fields, name: fields[name] - h_p}).image_from_normalised(n).xy
        np.testing.assert_allclose(jac[..., i], (up - down) / (2 * h_p), rtol=2e-4, atol=1e-4)


def test_camera_jacobians_match_differences() -> None:
    camera = paper_camera()
    points = np.random.default_rng(3).uniform(-5, 5, (10, 3))
    h = 1e-5
    for axis in range(3):
        step = np.eye(3)[axis] * h
        difference = (camera.project(points + step).xy - camera.project(points - step).xy) / (2 * h)
        np.testing.assert_allclose(camera.point_jacobian(points)[..., axis], difference, rtol=1e-5, atol=1e-5)
    base = camera.paper_parameters()
    jac = camera.parameter_jacobian(points)
    for i, name in enumerate(camera.parameter_names):
        h = 1e-11 if name == "kappa_per_px2" else 1e-6
        up = Camera.from_paper(**{**base, name: base[name] + h}).project(points).xy
        down = Camera.from_paper(**{**base, name: base[name] - h}).project(points).xy
        scale = np.abs(jac[..., i]).max()
        np.testing.assert_allclose(jac[..., i], (up - down) / (2 * h), atol=1e-5 * scale + 1e-6)


@pytest.mark.parametrize("lens", [SEIDEL, OPENCV, RATIONAL], ids=["seidel", "opencv", "rational"])
def test_camera_jacobian_of_any_lens_matches_differences(lens: LensModel) -> None:
    angles, position = (0.8, 0.02, 0.5), (0.3, -0.2, 40.0)
    points = np.random.default_rng(3).uniform(-4, 4, (10, 3))

    def project(values: dict[str, float]) -> Float:
        lens_values = {name: values[name] for name in lens.parameter_names}
        a, b, c, *t = (values[name] for name in POSE_NAMES)
        pose = RigidTransform(rotation_from_angles(a, b, c), np.array(t))
        return Camera(type(lens)(**lens_values), pose).project(points).xy

    camera = Camera(lens, RigidTransform(rotation_from_angles(*angles), np.array(position)))
    base = {name: getattr(lens, name) for name in lens.parameter_names}
    base.update(zip(POSE_NAMES, (*angles, *position), strict=True))
    assert camera.parameter_names == tuple(base)
    jac = camera.parameter_jacobian(points)
    assert jac.shape == (10, 2, len(base))
    for i, name in enumerate(camera.parameter_names):
        h = 1e-11 if name == "kappa_per_px2" else 1e-6
        difference = (project({**base, name: base[name] + h}) - project({**base, name: base[name] - h})) / (2 * h)
        # the differences carry the projection's rounding, 1e-12 px over the step
        np.testing.assert_allclose(jac[..., i], difference, atol=1e-5 * np.abs(jac[..., i]).max() + 1e-6)


def test_outside_the_domain_is_invalid_and_stays_alone() -> None:
    lens = SeidelLens(1000.0, 0.0, 0.0, 1e-6)
    # Eq. (7): 4 kappa rbar^2 < 1 ends at rbar = 500
    back = lens.normalised_from_image([[499.0, 0.0], [501.0, 0.0], [0.0, 10.0]])
    assert back.valid.tolist() == [True, False, True]
    assert np.isfinite(back.xy[[0, 2]]).all()
    forward = lens.image_from_normalised([[0.99, 0.0], [1.01, 0.0]])
    assert forward.valid.tolist() == [True, False]
    behind = Camera(lens, RigidTransform.identity()).project([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    assert behind.valid.tolist() == [False, True]
    folded = OpenCVLens(1000.0, 1000.0, 0.0, 0.0, k1=-0.3)
    assert folded.image_from_normalised([[1.0, 0.0], [1.2, 0.0]]).valid.tolist() == [True, False]
    assert folded.normalised_from_image([[600.0, 0.0], [900.0, 0.0]]).valid.tolist() == [True, False]


def test_back_projection_returns_to_the_plane() -> None:
    camera = paper_camera()
    grid = np.stack([*np.meshgrid(np.arange(-5.0, 6), np.arange(-5.0, 6)), np.zeros((11, 11))], -1)
    back = camera.back_project_to_plane(camera.project(grid).xy)
    np.testing.assert_allclose(back.xyz_mm, grid, atol=1e-9)
    assert not camera.back_project_to_plane([255.0, 241.0], point_sys_mm=camera.centre_sys_mm - [0, 0, 1.0]).valid


def test_pair_triangulates_and_has_no_epipolar_residual_on_true_points() -> None:
    pair = StereoPair(paper_camera(-0.5), paper_camera(0.5))
    points = np.random.default_rng(4).uniform(-5, 5, (30, 3))
    xy1, xy2 = pair.cam1.project(points).xy, pair.cam2.project(points).xy
    np.testing.assert_allclose(pair.triangulate(xy1, xy2).xyz_mm, points, atol=1e-8)
    np.testing.assert_allclose(pair.epipolar_residual_px(xy1, xy2), 0.0, atol=1e-7)
    offset = pair.epipolar_residual_px(xy1, np.add(xy2, [0.0, 0.1]))
    np.testing.assert_allclose(np.abs(offset), 0.1, rtol=0.02)  # lines run nearly along the rows
    depth = pair.cam1.cam_from_sys.apply(points)[:, 2]
    np.testing.assert_allclose(pair.image2_at_depth(xy1, depth), xy2, atol=1e-8)


@pytest.mark.parametrize("count", [0, 40, 900])
def test_a_lens_inverted_again_at_the_same_pixels_gives_the_same_numbers(count: int) -> None:
    lens = OpenCVLens(fx_px=1800.0, fy_px=1805.0, cx_px=640.0, cy_px=512.0, k1=-0.21, k2=0.09, p1=4e-4, p2=-3e-4)
    xy = np.random.default_rng(3).uniform([0.0, 0.0], [1280.0, 1024.0], (count, 2))
    first, again = lens.normalised_from_image(xy), lens.normalised_from_image(xy.copy())
    one_by_one = lens._normalised_from_image(xy)
    for found in (first, again):
        assert found.xy.tobytes() == one_by_one.xy.tobytes()
        assert found.valid.all()
        with pytest.raises(ValueError, match="read-only"):
            found.xy[:1] = 0.0
    moved = lens.normalised_from_image(xy + 1e-9)
    assert count == 0 or moved.xy.tobytes() != first.xy.tobytes()
    np.testing.assert_allclose(lens.image_from_normalised(moved.xy).xy, xy, atol=1e-7)
    single = lens.normalised_from_image([640.0, 512.0])
    assert single.xy.shape == (2,)
    assert single.valid
