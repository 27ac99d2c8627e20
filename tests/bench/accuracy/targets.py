"""Places of corners and dots against the Cramer-Rao bound, and beside OpenCV's own localisers, on the same images.

The bound of a point is that of the pixels nearer to it than to any other, from the renderer's own pictures of a board
shifted by a hundredth of a pixel: least variance of its place for the noise at hand. Levels, blur and the directions of the
edges are even about the point and its shift is odd, so that they cost nothing. On a ChArUco board the pixels of the
markers count for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget, BoardView, detect_board, dot_centre_offset_px
from stereorig.core.boards.view import steps_px
from tests.bench.accuracy.table import Row, Section
from tests.support.board_images import BoardCamera, exposed, render_board

NOISE = 2.0
LIGHT, DARK = 200.0, 40.0
SEEDS = 8
SIZE_PX = (640, 512)
_SHIFT_PX = 0.01
_LEAST_CHARUCO_PX = 25.0  # of smaller squares OpenCV reads no markers
_LENS = (-0.35, 0.12, 1e-3, -5e-4)  # a wide lens: lines bend by 10 px over the board

BOARDS = {
    "checkerboard": BoardTarget(kind="checkerboard", size=(9, 6), pitch_mm=10.0),
    "ChArUco": BoardTarget(kind="charuco", size=(9, 6), pitch_mm=10.0, marker_mm=7.0),
    "dots": BoardTarget(kind="circles", size=(9, 6), pitch_mm=10.0),
}


@dataclass(frozen=True)
class Case:
    """One way of seeing a board: distance of its points, px, blur, px, tilt, degrees, and lens."""

    pitch_px: float
    blur_px: float
    tilt_deg: float = 20.0
    lens: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def camera(self) -> BoardCamera:
        """Place the board."""
        tilt = np.radians(self.tilt_deg)
        turn = (0.6 * tilt, -0.8 * tilt, 0.1)
        return BoardCamera(turn=turn, depth_mm=900.0 * 10.0 / self.pitch_px, focal_px=900.0, lens=self.lens)

    def name(self) -> str:
        """Return the case in words."""
        lens = ", wide lens" if any(self.lens) else ""
        return f"{self.pitch_px:g} px apart, blur {self.blur_px:g} px, tilt {self.tilt_deg:g} degrees{lens}"


CASES = (
    Case(15.0, 0.7),
    Case(20.0, 1.5),
    Case(30.0, 0.5),
    Case(30.0, 1.0, 50.0),
    Case(45.0, 1.0, 20.0, _LENS),
    Case(60.0, 1.0),
)


@dataclass(frozen=True)
class Measured:
    """Figures of one case: rms error, its bound and the reported one, and OpenCV's errors by name; px an axis."""

    error_px: float
    bound_px: float
    reported_px: float
    others_px: dict[str, float]
    mean_px: float


def measured(target: BoardTarget, case: Case, *, seeds: int = SEEDS) -> Measured:
    """Find a board in images of fresh noise."""
    camera = case.camera()
    size = _room(camera, target)
    camera = replace(camera, centre_px=_centred(camera, target, size))
    clean = render_board(camera, target, size, blur_px=case.blur_px)
    truth = camera.project(target.points_mm())
    if target.kind == "circles":
        truth = truth + dot_centre_offset_px(lambda p: camera.project(p[..., :2]), target.points_mm(), 0.3 * 10.0)
    bound = _bound(camera, target, size, case.blur_px, camera.project(target.points_mm()))
    errors, told = [], []
    others: dict[str, list[Float]] = {}
    for seed in range(seeds):
        image = exposed(clean, noise=NOISE, seed=seed, light=LIGHT, dark=DARK)
        view = detect_board(image, target)
        errors.append(view.xy_px - truth)
        told.append(view.sigma_px**2)
        for name, found in _opencv(image, view):
            others.setdefault(name, []).append(found - truth)
    e = np.array(errors)
    return Measured(
        _rms(e), bound, _rms(np.sqrt(told)), {n: _rms(np.array(v)) for n, v in others.items()}, _rms(e.mean(axis=0))
    )


def _rms(values: Float) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def _room(camera: BoardCamera, target: BoardTarget) -> tuple[int, int]:
    xy = camera.project(target.points_mm() * 1.6)
    return (int(np.ceil(np.ptp(xy[..., 0]) / 16) * 16), int(np.ceil(np.ptp(xy[..., 1]) / 16) * 16))


def _centred(camera: BoardCamera, target: BoardTarget, size: tuple[int, int]) -> tuple[float, float]:
    xy = camera.project(target.points_mm())
    middle = 0.5 * (xy.max(axis=(0, 1)) + xy.min(axis=(0, 1)))
    cx, cy = np.array(camera.centre_px) - middle + 0.5 * np.array(size) + [0.21, -0.37]
    return float(cx), float(cy)


def _bound(camera: BoardCamera, target: BoardTarget, size: tuple[int, int], blur_px: float, xy: Float) -> float:
    """Rms over the points of the least standard deviation an axis."""
    plain = replace(target, kind="checkerboard") if target.kind == "charuco" else target
    slopes = []
    for axis in range(2):
        pair = []
        for sign in (1.0, -1.0):
            centre = np.array(camera.centre_px)
            centre[axis] += sign * _SHIFT_PX
            moved = replace(camera, centre_px=(float(centre[0]), float(centre[1])))
            pair.append(render_board(moved, plain, size, blur_px=blur_px))
        slopes.append((pair[0] - pair[1]) / (2.0 * _SHIFT_PX) * (DARK - LIGHT))
    g = np.stack(slopes, axis=-1)
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    axes = np.linalg.inv(np.stack([steps_px(xy, 0), steps_px(xy, 1)], axis=-1))
    frame = 0.5 * (1.0 - float(target.marker_mm or 0.0) / target.pitch_mm)
    variance = []
    for i in range(xy.shape[0]):
        for j in range(xy.shape[1]):
            d = np.stack([x - xy[i, j, 0], y - xy[i, j, 1]], axis=-1) @ axes[i, j].T
            mine = (np.abs(d) <= 0.5).all(axis=-1)
            if target.kind == "charuco":
                # the colours of the squares about a corner: OpenCV draws the first square of a board dark
                white = (d[..., 0] * d[..., 1] > 0) == ((i + j) % 2 == 1)
                mine &= ~(white & (np.abs(d) > frame).all(axis=-1))
            information = np.einsum("ni,nj->ij", g[mine], g[mine]) / (NOISE**2 + 1.0 / 12.0)
            variance.append(0.5 * np.trace(np.linalg.inv(information)))
    return float(np.sqrt(np.mean(variance)))


def _opencv(image: NDArray[np.uint8], view: BoardView) -> Iterator[tuple[str, Float]]:
    target = view.target
    columns, rows = target.size
    if target.kind == "circles":
        detector = cv2.SimpleBlobDetector.create(_blob_parameters())
        found, grid = cv2.findCirclesGrid(image, target.size, None, cv2.CALIB_CB_SYMMETRIC_GRID, detector)
        if found:
            yield "findCirclesGrid", _matched(np.asarray(grid), view)
        return
    start = (view.xy_px[np.isfinite(view.xy_px).all(axis=-1)] + 0.3).reshape(-1, 1, 2).astype(np.float32)
    half = max(int(0.25 * view.pitch_px), 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    yield "cornerSubPix", _matched(cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria), view)
    if target.kind == "checkerboard":
        flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, (columns, rows), flags=flags)
        if found:
            yield "findChessboardCornersSB", _matched(np.asarray(corners), view)


def _blob_parameters() -> cv2.SimpleBlobDetector.Params:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 20.0, 1e5
    parameters.filterByConvexity = parameters.filterByInertia = False
    return parameters


def _matched(points: Float, view: BoardView) -> Float:
    """Points in the view's order."""
    flat = points.reshape(-1, 2).astype(np.float64)
    distance = np.linalg.norm(np.nan_to_num(view.xy_px.reshape(-1, 1, 2), nan=1e9) - flat[None], axis=-1)
    out = flat[np.argmin(distance, axis=1)]
    out[distance.min(axis=1) > 0.3 * view.pitch_px] = np.nan
    return out.reshape(view.xy_px.shape)


def points_of_boards(figures: Path) -> Section:
    """Measure all boards in all cases."""
    rows: list[Row] = []
    results: dict[str, list[Measured]] = {}
    for name, target in BOARDS.items():
        for case in CASES:
            if target.kind == "charuco" and case.pitch_px < _LEAST_CHARUCO_PX:
                continue
            m = measured(target, case)
            results.setdefault(name, []).append(m)
            rows.append(Row(f"{name}, {case.name()}: rms error over the bound", m.error_px / m.bound_px, "", 1.15))
    for name, all_of in results.items():
        off = max(abs(m.reported_px / m.error_px - 1.0) for m in all_of)
        rows.append(Row(f"{name}: reported over rms error, departure from 1, worst case", off, "", 0.12))
        for other in sorted({n for m in all_of for n in m.others_px}):
            ratios = [m.others_px[other] / m.bound_px for m in all_of if other in m.others_px]
            rows.append(Row(f"{name}: OpenCV's {other} over the bound, best case", min(ratios), ""))
            rows.append(Row(f"{name}: OpenCV's {other} over the bound, worst case", max(ratios), ""))
    _drawing(figures / "target_points.png", results)
    how = (
        f"Boards of 9 x 6 points, {LIGHT - DARK:g} grey levels of contrast, noise {NOISE:g}, {SEEDS} images a case, rendered"
        " by area with a renderer of the tests' own. The bound counts the pixels that are nearer to a point than to any"
        " other, and none of a marker. Dots have a radius of 0.3 of their distance; their true places are those of the"
        " ellipses' centres, by the same formula as in the adjustment. OpenCV's corners start 0.3 px off, in windows of a"
        " quarter of the corners' distance."
    )
    caption = "Error of corners and dots over the Cramer-Rao bound, beside OpenCV's localisers."
    return Section("Corners and dots", how, rows, [("target_points.png", caption)], [])


def _drawing(path: Path, results: dict[str, list[Measured]]) -> None:
    figure, axes = plt.subplots(1, len(results), figsize=(10.0, 3.4), sharey=True)
    for ax, (name, all_of) in zip(axes, results.items(), strict=True):
        x = np.arange(len(CASES))[-len(all_of) :]
        ax.semilogy(x, [m.error_px / m.bound_px for m in all_of], "o-", label="stereorig")
        for other in sorted({n for m in all_of for n in m.others_px}):
            ax.semilogy(
                x, [m.others_px.get(other, np.nan) / m.bound_px for m in all_of], "s--", label=f"OpenCV {other}"
            )
        ax.axhline(1.0, color="0.5", lw=0.8)
        ax.set_title(name)
        labels = [
            f"{c.pitch_px:g} px\n{c.blur_px:g} px\n{c.tilt_deg:g}°{' lens' if any(c.lens) else ''}" for c in CASES
        ]
        ax.set_xticks(np.arange(len(CASES)), labels, fontsize=7)
        ax.legend(fontsize=7)
    axes[0].set_ylabel("rms error over the bound")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


SECTIONS: dict[str, Callable[[Path], Section]] = {"targets": points_of_boards}
