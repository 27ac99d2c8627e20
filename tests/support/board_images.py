"""Images of boards from a renderer of their own: the truth that their detection is held against.

Every pixel holds the area that is dark, from samples whose rays are met with the board's plane; the sum is blurred by a
Gaussian at the samples' scale. It shares no code with the detection, nor with the simulated rig: the lens is its own,
and a sample's cover is a ramp over its own width, not the error function of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget

_MARKER_SQUARE_PX = 240
HOLLOW = 0.5  # inner over outer radius of a hollow dot


@dataclass(frozen=True, kw_only=True)
class BoardCamera:
    """A camera before a board.

    Attributes
    ----------
    turn
        (3,) rotation vector of the board, rad.
    depth_mm
        Of the board's centre.
    focal_px, centre_px
        Focal length and principal point.
    lens
        k1, k2, p1, p2 of OpenCV's model.
    shift_mm
        (2,) of the board's centre across the camera.
    """

    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_mm: float = 230.0
    focal_px: float = 1100.0
    centre_px: tuple[float, float] = (322.4, 251.7)
    lens: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    shift_mm: tuple[float, float] = (0.0, 0.0)

    def plane(self) -> Float:
        """Return (3, 3) from (X, Y, 1) on the board to the camera's frame."""
        R = cv2.Rodrigues(np.array(self.turn, dtype=np.float64))[0]
        return np.asarray(np.column_stack([R[:, 0], R[:, 1], [*self.shift_mm, self.depth_mm]]))

    def project(self, points_mm: Float) -> Float:
        """Return the image (..., 2) of points (..., 2) on the board."""
        q = np.concatenate([points_mm, np.ones((*points_mm.shape[:-1], 1))], axis=-1) @ self.plane().T
        x, y = q[..., 0] / q[..., 2], q[..., 1] / q[..., 2]
        k1, k2, p1, p2 = self.lens
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.asarray(np.stack([xd, yd], axis=-1) * self.focal_px + self.centre_px)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """How a board is drawn: radius of its dots in pitches, and the dots (column, row) that are hollow or larger."""

    dot_radius: float = 0.3
    hollow: tuple[tuple[int, int], ...] = ()
    larger: tuple[tuple[int, int], ...] = ()
    missing: tuple[tuple[int, int], ...] = field(default=())
    dark_ground: bool = False


def render_board(
    camera: BoardCamera,
    target: BoardTarget,
    size_px: tuple[int, int] = (640, 512),
    *,
    blur_px: float = 0.9,
    samples: int = 6,
    drawn: Drawn | None = None,
) -> Float:
    """Return the dark part (rows, columns) in [0, 1] of each pixel."""
    drawn = drawn or Drawn()
    kinds = {"checkerboard": 0, "charuco": 1, "circles": 2, "circles_asymmetric": 3}
    origin = target.points_mm().min(axis=(0, 1))
    marks = np.zeros(target.size, dtype=np.int64)
    for value, places in ((1, drawn.hollow), (2, drawn.larger), (3, drawn.missing)):
        for i, j in places:
            marks[i, j] = value
    fine = _render(
        size_px[0],
        size_px[1],
        samples,
        np.asarray(np.linalg.inv(camera.plane()), dtype=np.float64),
        camera.focal_px,
        np.array(camera.centre_px),
        np.array(camera.lens),
        origin,
        target.pitch_mm,
        kinds[target.kind],
        target.size[0],
        target.size[1],
        drawn.dot_radius,
        marks,
        _marker_picture(target),
    )
    if drawn.dark_ground:
        fine = 1.0 - fine
    return _pixels(fine, samples, blur_px)


def _pixels(fine: NDArray[np.float32], samples: int, blur_px: float) -> Float:
    """Blur and mean over each pixel at once; beyond the picture its rim goes on."""
    weight = np.full(samples, 1.0 / samples)
    if blur_px > 0.0:
        reach = int(np.ceil(4.5 * blur_px * samples))
        gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (blur_px * samples)) ** 2)
        weight = np.convolve(gauss / gauss.sum(), weight)
    rim = (len(weight) - samples) // 2
    return np.asarray(_weigh(np.pad(fine, rim, mode="edge"), weight.astype(np.float32), samples))


def board_image(
    camera: BoardCamera,
    target: BoardTarget,
    size_px: tuple[int, int] = (640, 512),
    *,
    noise: float = 2.0,
    seed: int = 0,
    light: float = 200.0,
    dark: float = 40.0,
    blur_px: float = 0.9,
    samples: int = 6,
    drawn: Drawn | None = None,
) -> NDArray[np.uint8]:
    """Render, expose, and digitise to eight bits."""
    cover = render_board(camera, target, size_px, blur_px=blur_px, samples=samples, drawn=drawn)
    return exposed(cover, noise=noise, seed=seed, light=light, dark=dark)


def exposed(
    cover: Float, *, noise: float = 2.0, seed: int = 0, light: float = 200.0, dark: float = 40.0
) -> NDArray[np.uint8]:
    """Give a picture of dark parts grey levels, noise and eight bits."""
    grey = light + (dark - light) * cover + np.random.default_rng(seed).normal(0.0, noise, cover.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _marker_picture(target: BoardTarget) -> NDArray[np.uint8]:
    if target.kind != "charuco":
        return np.zeros((1, 1), dtype=np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    squares = (target.size[0] + 1, target.size[1] + 1)
    board = cv2.aruco.CharucoBoard(squares, target.pitch_mm, float(target.marker_mm or 0.0), dictionary)
    side = _MARKER_SQUARE_PX
    return np.asarray(board.generateImage((squares[0] * side, squares[1] * side)), dtype=np.uint8)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _weigh(fine: NDArray[np.float32], weight: NDArray[np.float32], samples: int) -> Float:
    """Weigh the samples of each pixel and its surroundings, along the rows and then down the columns."""
    n = len(weight)
    rows, columns = (fine.shape[0] - n) // samples + 1, (fine.shape[1] - n) // samples + 1
    out = np.zeros((rows, columns))
    summed = np.empty(columns)
    for j in range(fine.shape[0]):
        line = fine[j]
        for c in range(columns):
            total = np.float32(0.0)
            for k in range(n):
                total += weight[k] * line[c * samples + k]
            summed[c] = total
        for r in range(max(0, (j - n + samples) // samples), min(rows, j // samples + 1)):
            w = weight[j - r * samples]
            for c in range(columns):
                out[r, c] += w * summed[c]
    return out


@njit(cache=True, nogil=True)
def _ramp(distance: float, width: float) -> float:
    return min(max(distance / width + 0.5, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _cover(
    X: float,
    Y: float,
    w: float,
    kind: int,
    columns: int,
    rows: int,
    radius: float,
    marks: NDArray[np.int64],
    picture: NDArray[np.uint8],
) -> float:
    """Dark part of a sample of width ``w`` at X, Y, in pitches from the point [0, 0]."""
    if kind <= 1:
        inside = _ramp(X + 1.0, w) * _ramp(columns - X, w) * _ramp(Y + 1.0, w) * _ramp(rows - Y, w)
        if inside <= 0.0:
            return 0.0
        i, j = int(np.floor(X + 0.5)), int(np.floor(Y + 0.5))
        sx = 2.0 * _ramp(X - i, w) - 1.0
        sy = 2.0 * _ramp(Y - j, w) - 1.0
        parity = 1.0 if (i + j) % 2 == 0 else -1.0
        if kind == 1:
            n = _MARKER_SQUARE_PX
            # the colour of the square right below the point [0, 0] beside its corner
            if picture[n + 2, n + 2] > 128:
                parity = -parity
            px = min(max(int((X + 1.0) * n), 0), picture.shape[1] - 1)
            py = min(max(int((Y + 1.0) * n), 0), picture.shape[0] - 1)
            u, v = X - np.floor(X), Y - np.floor(Y)
            if min(u, v, 1.0 - u, 1.0 - v) > 0.05:  # inside a square: the marker, if it has one
                return inside if picture[py, px] < 128 else 0.0
        return inside * (0.5 + 0.5 * sx * sy * parity)
    j = int(np.floor(Y + 0.5))
    if j < 0 or j >= rows:
        return 0.0
    shift = float(j % 2) if kind == 3 else 0.0
    step = 2.0 if kind == 3 else 1.0
    i = int(np.floor((X - shift) / step + 0.5))
    if i < 0 or i >= columns:
        return 0.0
    mark = marks[i, j]
    if mark == 3:
        return 0.0
    r = radius * (1.35 if mark == 2 else 1.0)
    distance = np.sqrt((X - shift - step * i) ** 2 + (Y - j) ** 2)
    cover = _ramp(r - distance, w)
    if mark == 1:
        cover -= _ramp(HOLLOW * r - distance, w)
    return cover


@njit(cache=True, nogil=True)
def _render(
    width: int,
    height: int,
    samples: int,
    to_plane: Float,
    focal: float,
    centre: Float,
    lens: Float,
    origin: Float,
    pitch: float,
    kind: int,
    columns: int,
    rows: int,
    radius: float,
    marks: NDArray[np.int64],
    picture: NDArray[np.uint8],
) -> NDArray[np.float32]:
    out = np.zeros((height * samples, width * samples), dtype=np.float32)
    k1, k2, p1, p2 = lens
    root = np.sqrt(abs(np.linalg.det(to_plane)))
    for row in range(height * samples):
        yd = ((row + 0.5) / samples - 0.5 - centre[1]) / focal
        from_x, from_y = 0.0, 0.0  # what the lens moved the sample before by
        for column in range(width * samples):
            xd = ((column + 0.5) / samples - 0.5 - centre[0]) / focal
            x, y = xd + from_x, yd + from_y
            if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0:
                for _ in range(30):
                    r2 = x * x + y * y
                    radial = 1.0 + r2 * (k1 + r2 * k2)
                    nx = (xd - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial
                    ny = (yd - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial
                    moved = abs(nx - x) + abs(ny - y)
                    x, y = nx, ny
                    if moved < 1e-10:
                        break
                from_x, from_y = x - xd, y - yd
            q0 = to_plane[0, 0] * x + to_plane[0, 1] * y + to_plane[0, 2]
            q1 = to_plane[1, 0] * x + to_plane[1, 1] * y + to_plane[1, 2]
            q2 = to_plane[2, 0] * x + to_plane[2, 1] * y + to_plane[2, 2]
            X = (q0 / q2 - origin[0]) / pitch
            Y = (q1 / q2 - origin[1]) / pitch
            # the sample's width in pitches, by its area on the board
            w = root / (abs(q2) * np.sqrt(abs(q2)) * samples * focal * pitch)
            out[row, column] = _cover(X, Y, w, kind, columns, rows, radius, marks, picture)
    return out
