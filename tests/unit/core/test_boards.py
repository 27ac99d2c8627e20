"""Boards in images: places against rendered truth, the order of points, partly seen boards, other boards by name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget, detect_board
from stereorig.core.boards.kernels import CORNER, DOT, model_values
from stereorig.core.errors import StereorigError, TargetError

NOISE, BLUR_PX = 2.0, 0.9
SIZE_PX = (640, 512)
KINDS = {
    "checkerboard": BoardTarget(kind="checkerboard", size=(9, 6), pitch_mm=10.0),
    "charuco": BoardTarget(kind="charuco", size=(9, 6), pitch_mm=10.0, marker_mm=7.0, dictionary="DICT_5X5_100"),
    "circles": BoardTarget(kind="circles", size=(9, 7), pitch_mm=10.0),
    "circles_asymmetric": BoardTarget(kind="circles_asymmetric", size=(4, 11), pitch_mm=8.0),
}
K = np.array([[1100.0, 0.0, 322.4], [0.0, 1098.0, 251.7], [0.0, 0.0, 1.0]])
_PX_MM = 24  # pixels of the drawing a mm


def _drawing(target: BoardTarget) -> tuple[NDArray[np.uint8], Float]:
    """Draw the board in the plane: its picture, and the place of the point [0, 0] there in mm."""
    if target.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
        squares = (target.size[0] + 1, target.size[1] + 1)
        board = cv2.aruco.CharucoBoard(squares, target.pitch_mm, float(target.marker_mm or 0.0), dictionary)
        side = round(target.pitch_mm * _PX_MM)
        picture = np.asarray(board.generateImage((squares[0] * side, squares[1] * side)))
        margin = side
        framed = cv2.copyMakeBorder(picture, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
        return np.asarray(framed), np.array([2.0, 2.0]) * target.pitch_mm
    points = target.points_mm()
    points = points - points.min(axis=(0, 1))
    margin = 2.0 * target.pitch_mm
    extent = points.max(axis=(0, 1)) + 2.0 * margin
    x, y = np.meshgrid(*((np.arange(round(e * _PX_MM)) + 0.5) / _PX_MM - margin for e in extent))
    if target.kind == "checkerboard":
        i, j = np.floor(x / target.pitch_mm), np.floor(y / target.pitch_mm)
        inside = (i >= -1) & (j >= -1) & (i < target.size[0]) & (j < target.size[1])
        dark = inside & ((i + j) % 2 == 0)
    else:
        dark = np.zeros(x.shape, dtype=bool)
        for px, py in points.reshape(-1, 2):
            dark |= (x - px) ** 2 + (y - py) ** 2 < (0.3 * target.pitch_mm) ** 2
    return np.where(dark, 0, 255).astype(np.uint8), np.array([margin, margin])


def _rendered(
    target: BoardTarget, *, turn: tuple[float, float, float] = (0.25, -0.3, 0.1), depth_mm: float = 230.0, seed: int = 1
) -> tuple[NDArray[np.uint8], Float]:
    """An image of the board by a homography of the drawing, 6 x 6 samples a pixel; and its points by the same."""
    picture, origin = _drawing(target)
    R = cv2.Rodrigues(np.array(turn))[0]
    centre = np.array([picture.shape[1], picture.shape[0]]) / (2.0 * _PX_MM)
    t = np.array([0.0, 0.0, depth_mm])
    plane = K @ np.column_stack([R[:, 0], R[:, 1], t - R[:, :2] @ centre])  # mm of the drawing to pixels
    to_mm = np.diag([1.0 / _PX_MM, 1.0 / _PX_MM, 1.0]) @ np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1.0]])
    fine = 6
    finer = np.diag([fine, fine, 1.0]) @ np.array([[1, 0, 0.5 - 0.5 / fine], [0, 1, 0.5 - 0.5 / fine], [0, 0, 1.0]])
    size = (SIZE_PX[0] * fine, SIZE_PX[1] * fine)
    image = cv2.warpPerspective(
        picture, finer @ plane @ to_mm, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255
    )
    image = cv2.resize(image, SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float64)
    image = 30.0 + 0.7 * cv2.GaussianBlur(image, (0, 0), BLUR_PX)
    image += np.random.default_rng(seed).normal(0.0, NOISE, image.shape)
    points = target.points_mm()
    points = points - points[0, 0] + origin
    if target.kind == "circles_asymmetric":
        points = target.points_mm() - target.points_mm().min(axis=(0, 1)) + origin
    homogeneous = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1) @ plane.T
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), homogeneous[..., :2] / homogeneous[..., 2:]


@pytest.mark.parametrize("kind", list(KINDS))
def test_points_lie_where_the_board_was_drawn(kind: str) -> None:
    target = KINDS[kind]
    image, truth = _rendered(target)
    view = detect_board(image, target)
    assert view.found == truth.shape[0] * truth.shape[1]
    error = view.xy_px - truth
    if kind.startswith("circles"):
        # the ellipse's centre is not the image of the dot's: a few hundredths of a pixel, smooth over the board
        assert np.sqrt(np.mean(error**2)) < 0.06
        return
    rms = float(np.sqrt(np.mean(error**2)))
    told = float(np.sqrt(np.mean(view.sigma_px**2)))
    assert rms < 0.03
    assert 0.7 < rms / told < 1.4


@pytest.mark.parametrize("kind", ["checkerboard", "charuco"])
@pytest.mark.parametrize("roll", [0.0, 0.8, 2.0, np.pi, -1.4])
def test_the_boards_own_colours_order_its_corners_at_any_roll(kind: str, roll: float) -> None:
    target = KINDS[kind]
    image, truth = _rendered(target, turn=(0.0, 0.0, roll), depth_mm=220.0)
    assert np.nanmax(np.abs(detect_board(image, target).xy_px - truth)) < 0.3


def test_a_charuco_board_is_found_in_part() -> None:
    target = KINDS["charuco"]
    image, truth = _rendered(target)
    image[:, :260] = 128
    view = detect_board(image, target)
    seen = np.isfinite(view.xy_px).all(axis=-1)
    assert 12 < seen.sum() < seen.size
    assert np.abs(view.xy_px - truth)[seen].max() < 0.15


@pytest.mark.parametrize(
    ("shown", "declared", "code", "word"),
    [
        ("checkerboard", "charuco", "target_other", "checkerboard of 9 x 6"),
        ("checkerboard", "circles", "target_other", "checkerboard of 9 x 6"),
        ("circles", "checkerboard", "target_other", "dots"),
    ],
)
def test_another_board_is_named(shown: str, declared: str, code: str, word: str) -> None:
    image, _ = _rendered(KINDS[shown])
    with pytest.raises(TargetError) as caught:
        detect_board(image, KINDS[declared])
    assert caught.value.code == code
    assert word in caught.value.cause


def test_markers_tell_a_charuco_board_from_a_checkerboard_of_another_size() -> None:
    image, _ = _rendered(KINDS["charuco"])
    with pytest.raises(TargetError) as caught:
        detect_board(image, BoardTarget(kind="checkerboard", size=(11, 8), pitch_mm=10.0))
    assert caught.value.code == "target_other"
    assert "ChArUco" in caught.value.cause


def test_a_board_of_another_size_is_named_with_its_size() -> None:
    image, _ = _rendered(KINDS["checkerboard"])
    with pytest.raises(TargetError) as caught:
        detect_board(image, BoardTarget(kind="checkerboard", size=(8, 5), pitch_mm=10.0))
    assert caught.value.code in ("target_size", "target_not_found")
    with pytest.raises(TargetError) as caught:
        detect_board(image, BoardTarget(kind="checkerboard", size=(11, 8), pitch_mm=10.0))
    assert caught.value.code == "target_size"
    assert "9 x 6" in caught.value.cause


def test_an_empty_image_shows_nothing() -> None:
    empty = np.full((480, 640), 90, dtype=np.uint8)
    for target in KINDS.values():
        with pytest.raises(TargetError) as caught:
            detect_board(empty, target)
        assert caught.value.code == "target_not_found"


def test_real_boards_are_found_in_both_cameras(shared_dir: Path) -> None:
    target = KINDS["checkerboard"]
    for name in ("left01", "right01", "left04", "right04", "left14", "right14"):
        path = shared_dir / "data" / "opencv_boards" / f"{name}.jpg"
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        view = detect_board(image, target)
        assert view.found == 54
        _, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_ACCURACY)
        other = np.swapaxes(np.asarray(corners).reshape(6, 9, 2), 0, 1)
        distance = np.linalg.norm(view.xy_px.reshape(-1, 1, 2) - other.reshape(1, -1, 2), axis=-1).min(axis=1)
        assert np.median(distance) < 0.15


@pytest.mark.parametrize("kind", ["corner", "charuco corner", "dot"])
def test_derivatives_of_the_pictures_are_those_of_differences(kind: str) -> None:
    model, start, geometry = {
        "corner": (CORNER, [10.3, 9.8, 0.2, 1.7, 100.0, 60.0, 1.1, 0.2, -0.1], [0.0] * 5 + [1e-3, -2e-3] + [0.0] * 6),
        "charuco corner": (
            CORNER,
            [10.3, 9.8, 0.2, 1.7, 100.0, -60.0, 1.1, 0.2, -0.1],
            [0.0] * 7 + [3.0, 3.3] + [0.0] * 4,
        ),
        "dot": (DOT, [10.3, 9.8, 0.21, 0.03, 0.18, 100.0, -60.0, 1.1, 0.2, -0.1], [0.0] * 13),
    }[kind]
    x, y = (g.ravel().astype(np.float64) for g in np.meshgrid(np.arange(21), np.arange(21)))
    p, g = np.array(start), np.array(geometry)
    _, jac = model_values(model, p, g, x, y)
    for k in range(len(p)):
        step = np.zeros_like(p)
        step[k] = 1e-6
        difference = (model_values(model, p + step, g, x, y)[0] - model_values(model, p - step, g, x, y)[0]) / 2e-6
        largest = np.abs(difference).max()
        if kind == "dot" and k in (0, 1, 2, 3, 4, 7):
            # the distance to the ellipse is to first order, and so are its derivatives: exact on the rim itself
            rim = np.abs(difference) > 0.5 * largest
            np.testing.assert_allclose(jac[rim, k], difference[rim], atol=0.25 * largest)
            continue
        # an edge's bend turns with the edge, which is left out: 2e-3 / px over 10 px is 4 % of an angle's derivative
        allowed = 0.06 if kind == "corner" and k in (0, 1, 2, 3) else 2e-5
        np.testing.assert_allclose(jac[:, k], difference, atol=allowed * max(1.0, largest))


@pytest.mark.parametrize(
    "wrong",
    [
        {"size": (2, 6)},
        {"pitch_mm": 0.0},
        {"kind": "triangles"},
        {"kind": "charuco"},
        {"kind": "charuco", "marker_mm": 12.0},
        {"node_tolerance_mm": 3.0},
    ],
)
def test_a_wrong_description_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(StereorigError) as caught:
        BoardTarget(**{"kind": "checkerboard", "size": (9, 6), "pitch_mm": 10.0, **wrong})  # type: ignore[arg-type]
    assert caught.value.code == "target_invalid"


@pytest.mark.parametrize("declared", [(8, 6), (9, 5), (7, 5)])
def test_a_checkerboard_with_more_corners_than_declared_is_no_board_of_the_declared_size(
    declared: tuple[int, int],
) -> None:
    squares = np.indices((7, 10)).sum(axis=0) % 2
    picture = np.full((480, 640), 200.0)
    picture[80:395, 95:545] = 60.0 + 140.0 * np.kron(squares, np.ones((45, 45)))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + np.random.default_rng(1).normal(0.0, 2.0, picture.shape)
    found = detect_board(picture, BoardTarget(kind="checkerboard", size=(9, 6), pitch_mm=1.0))
    assert np.isfinite(found.xy_px).all()
    with pytest.raises(TargetError) as caught:
        detect_board(picture, BoardTarget(kind="checkerboard", size=declared, pitch_mm=1.0))
    assert caught.value.code == "target_size"
