"""Real pictures of a hand-held checkerboard: fitted on some pairs, tested on the others, beside stereoCalibrate."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.boards import BoardTarget
from stereorig.core.boards.detect import detect_board
from stereorig.core.calibration import CalibrationOptions, CalibrationView, NominalValues, calibrate
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from tests.bench.accuracy.paper_rig import ROOT
from tests.bench.accuracy.table import Row, Section
from tests.support.calibration_rigs import Array, rms, stereo_calibrate

NUMBERS = tuple(k for k in range(1, 15) if k != 10)
SIZE = (640, 480)
#: lengths are in squares; a printed board is right to some hundredths of a square
BOARD = BoardTarget(kind="checkerboard", size=(9, 6), pitch_mm=1.0, node_tolerance_mm=0.02)
FOLDS = 2

Corners = dict[tuple[str, int], Array]


def boards_folder() -> Path | None:
    """The folder of pictures beside the checkout; None where it is not there."""
    named = os.environ.get("STEREORIG_SHARED")
    candidates = [Path(named)] if named else []
    candidates += [ROOT.parent / "shared", ROOT.parent.parent / "shared"]
    for folder in candidates:
        if (folder / "data" / "opencv_boards" / "left01.jpg").is_file():
            return folder / "data" / "opencv_boards"
    return None


def _picture(folder: Path, camera: str, number: int) -> np.ndarray:
    image = cv2.imread(str(folder / f"{'left' if camera == 'cam1' else 'right'}{number:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def our_views(folder: Path) -> list[CalibrationView]:
    """Every view with the corners that the product finds."""
    out = []
    for number in NUMBERS:
        for camera in CAMERAS:
            found = detect_board(_picture(folder, camera, number), BOARD)
            out.append(
                CalibrationView(camera, None, found.xy_px, found.sigma_px, f"{camera}, pair {number}", frame=number)
            )
    return out


def opencv_views(folder: Path) -> list[CalibrationView]:
    """Every view with OpenCV's corners, refined by cornerSubPix as its sample does."""
    out = []
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    for number in NUMBERS:
        for camera in CAMERAS:
            image = _picture(folder, camera, number)
            good, corners = cv2.findChessboardCorners(image, BOARD.size)
            assert good, number
            xy = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), criteria).reshape(BOARD.size[1], BOARD.size[0], 2)
            out.append(CalibrationView(camera, None, xy.swapaxes(0, 1).astype(np.float64), frame=number))
    return out


@dataclass(frozen=True)
class Tested:
    """What views that a calibration did not use say of it: epipolar distances, px; sides over their mean, minus one."""

    epipolar_px: Array
    sides: Array


def test_on(pair: StereoPair, views: Sequence[CalibrationView]) -> Tested:
    """Hold a pair against views."""
    frames = sorted({v.frame for v in views if v.frame is not None})
    relative = pair.cam2.cam_from_sys @ pair.cam1.cam_from_sys.inverse()
    R, t = relative.rotation, relative.translation_mm
    E = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]]) @ R
    distances, sides = [], []
    for frame in frames:
        one, two = (next(v.xy_px for v in views if v.frame == frame and v.camera == n) for n in CAMERAS)
        a, b = (
            np.concatenate([c.lens.normalised_from_image(xy).xy, np.ones((*xy.shape[:2], 1))], axis=-1).reshape(-1, 3)
            for c, xy in ((pair.cam1, one), (pair.cam2, two))
        )
        line2, line1 = a @ E.T, b @ E
        algebraic = np.einsum("ni,ni->n", b, line2)
        focal = float(np.mean([cv2_focal(c.lens) for c in (pair.cam1, pair.cam2)]))
        # both cameras' corners share the offset
        distances.append(focal * algebraic / np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1)))
        xyz = pair.triangulate(one, two).xyz_mm
        sides += [np.linalg.norm(np.diff(xyz, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    joined, every = np.concatenate(distances), np.concatenate(sides)
    joined, every = joined[np.isfinite(joined)], every[np.isfinite(every)]
    return Tested(joined, every / every.mean() - 1.0)


def cv2_focal(lens: object) -> float:
    """Pinhole distance along the rows of either kind of lens."""
    return float(getattr(lens, "fx_px", getattr(lens, "phd_px", np.nan)))


test_on.__test__ = False  # type: ignore[attr-defined]


def split(views: Sequence[CalibrationView], fold: int) -> tuple[list[CalibrationView], list[CalibrationView]]:
    """Return the views to fit and those to test: every other pair, and the other way round."""
    chosen = set(NUMBERS[fold::FOLDS])
    return [v for v in views if v.frame not in chosen], [v for v in views if v.frame in chosen]


def ours(fit: Sequence[CalibrationView]) -> StereoPair:
    """The product's calibration of some of the views."""
    nominal = NominalValues(SIZE, 600.0)
    return calibrate(list(fit), BOARD, (nominal, nominal), CalibrationOptions(moves="free")).pair


def held_against_each_other(folder: Path) -> dict[str, list[Tested]]:
    """Each way of calibrating, tested fold by fold on the views that it did not see."""
    mine, theirs = our_views(folder), opencv_views(folder)
    points = BOARD.points_mm()
    out: dict[str, list[Tested]] = {"here": [], "OpenCV, these corners": [], "OpenCV, its own corners": []}
    for fold in range(FOLDS):
        fit, test = split(mine, fold)
        out["here"].append(test_on(ours(fit), test))
        whole = _whole(fit)
        out["OpenCV, these corners"].append(test_on(stereo_calibrate(whole, points, SIZE).pair, test))
        fit, test = split(theirs, fold)
        out["OpenCV, its own corners"].append(test_on(stereo_calibrate(fit, points, SIZE).pair, test))
    return out


def _whole(views: Sequence[CalibrationView]) -> list[CalibrationView]:
    lacking = {v.frame for v in views if not v.found.all()}
    return [v for v in views if v.frame not in lacking]


def real_boards(figures: Path) -> Section:
    """Epipolar distance and scatter of the sides on views left out."""
    folder = boards_folder()
    if folder is None:
        raise SystemExit("the real boards are not there: put shared/data/opencv_boards beside the checkout")
    found = held_against_each_other(folder)
    rows: list[Row] = []
    fig, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for name, parts in found.items():
        epipolar = np.concatenate([p.epipolar_px for p in parts])
        sides = np.concatenate([p.sides for p in parts])
        rows += [
            Row(f"{name}: epipolar distance of pairs left out, rms", rms(epipolar.tolist()), "px"),
            Row(f"{name}: scatter of the squares' sides there, rms", 100.0 * rms(sides.tolist()), "%"),
            Row(f"{name}: the same, robust", 148.26 * float(np.median(np.abs(sides - np.median(sides)))), "%"),
        ]
        axes[0].plot(np.sort(np.abs(epipolar)), np.linspace(0, 1, len(epipolar)), label=name)
        axes[1].plot(100.0 * np.sort(np.abs(sides)), np.linspace(0, 1, len(sides)), label=name)
    here, beside = (np.concatenate([p.epipolar_px for p in found[k]]) for k in ("here", "OpenCV, these corners"))
    rows.append(Row("epipolar distance over OpenCV's on the same corners", rms(here) / rms(beside), "1", 1.05))
    axes[0].set(xlabel="epipolar distance, px", ylabel="share of corners", xscale="log")
    axes[1].set(xlabel="side off the mean, %", xscale="log")
    axes[0].legend(fontsize=8)
    fig.savefig(figures / "accuracy_real_boards.png", dpi=100)
    plt.close(fig)
    return Section(
        "Real boards",
        "OpenCV's samples: thirteen pairs of a hand-held 9 x 6 checkerboard, 640 x 480 px, JPEG, a wide lens and a printed "
        "board. Fitted on every other pair, tested on the rest, and the other way round; every corner of the tested pairs.",
        rows,
        [("accuracy_real_boards.png", "Epipolar distances and sides on pairs left out")],
        [
            f"The board's tolerance was declared as {BOARD.node_tolerance_mm:g} of a square. A side is off by its print, by "
            "the board's shape, by both corners and by the calibration; a scale common to all pairs does not show."
        ],
    )
