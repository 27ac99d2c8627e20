"""Points of calibration targets projected by OpenCV, to calibrate from; shares nothing with the camera model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationView, NominalValues
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

Array = NDArray[np.float64]

FOCAL_PX, SIZE_PX, DISTANCE_MM = 3500.0, (2448, 2048), 350.0
LENSES: dict[str, tuple[float, ...]] = {
    "pinhole": (0.0, 0.0, 0.0, 0.0, 0.0),
    "k1 k2": (-0.05, 0.02, 0.0, 0.0, 0.0),
    "p1 p2 of 1e-4": (-0.05, 0.0, 1e-4, -1.5e-4, 0.0),
    "p1 p2 of 3e-4": (-0.05, 0.02, 2e-4, -3e-4, 0.0),
}
CHECKERBOARD = BoardTarget(kind="checkerboard", size=(9, 7), pitch_mm=14.0)


@dataclass(frozen=True)
class TrueCamera:
    """A camera as OpenCV has it, in the system frame."""

    rotation: Array
    translation_mm: Array
    distortion: tuple[float, ...] = LENSES["pinhole"]
    centre_px: tuple[float, float] = (1230.0, 1010.0)
    focal_px: float = FOCAL_PX

    def image(self, points_mm: Array, shift_cam_mm: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
        """Images (..., 2) of points (..., 3); the shift is in the camera's own frame."""
        p = points_mm @ self.rotation.T + self.translation_mm + np.asarray(shift_cam_mm)
        K = np.array([[self.focal_px, 0.0, self.centre_px[0]], [0.0, self.focal_px, self.centre_px[1]], [0, 0, 1.0]])
        xy, _ = cv2.projectPoints(p.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(self.distortion))
        return np.asarray(xy, dtype=np.float64).reshape(*points_mm.shape[:-1], 2)


def true_pair(
    lens: str = "pinhole", *, angle_deg: float = 12.5, roll_deg: float = 2.0, distance_mm: float = DISTANCE_MM
) -> tuple[TrueCamera, TrueCamera]:
    """Two cameras that look at the origin from ``angle_deg`` to either side, Z away from them."""
    one, two = (
        TrueCamera(
            Rotation.from_euler("y", sign * angle_deg, degrees=True).as_matrix()
            @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix(),
            np.array([1.0, -2.0, distance_mm]),
            LENSES[lens],
        )
        for sign in (-1.0, 1.0)
    )
    return one, two


def nominal_pair(angle_deg: float | None = 12.5) -> tuple[NominalValues, NominalValues]:
    """Nominal cameras, some per cent off."""
    if angle_deg is None:
        return NominalValues(SIZE_PX, 1.1 * FOCAL_PX), NominalValues(SIZE_PX, 0.95 * FOCAL_PX)
    one, two = (NominalValues(SIZE_PX, 1.01 * FOCAL_PX, 1.02 * DISTANCE_MM, s * angle_deg) for s in (-1.0, 1.0))
    return one, two


@dataclass(frozen=True)
class FreeViews:
    """Views of a board in free poses, and the truth."""

    views: list[CalibrationView]
    points_mm: Array  # (frame, n, 3), system frame of the true cameras
    cameras: tuple[TrueCamera, TrueCamera]
    poses: list[tuple[Array, Array]] = field(default_factory=list)


def random_pose(rng: np.random.Generator, tilt_deg: float = 35.0, span_mm: float = 60.0) -> tuple[Array, Array]:
    """A turn and a shift as of a board held by hand."""
    axis, tilt = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(0.2, 1.0) * tilt_deg)
    R = Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0.0])).as_matrix()
    R = R @ Rotation.from_euler("z", rng.uniform(-25.0, 25.0), degrees=True).as_matrix()
    return R, np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.5, 0.5), rng.uniform(-1.0, 1.0)]) * span_mm


def free_views(
    cameras: tuple[TrueCamera, TrueCamera],
    *,
    board: BoardTarget = CHECKERBOARD,
    count: int = 15,
    noise_px: float = 0.02,
    seed: int = 0,
    errors_mm: Array | None = None,
    tilt_deg: float = 35.0,
) -> FreeViews:
    """Draw views of a board that both cameras see whole.

    ``errors_mm`` (columns, rows, 3) are the board's departures from its description.
    """
    rng = np.random.default_rng(seed)
    flat = board.points_mm()
    points = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
    if errors_mm is not None:
        points = points + errors_mm
    views: list[CalibrationView] = []
    placed, poses = [], []
    while len(placed) < count:
        R, t = random_pose(rng, tilt_deg)
        body = points @ R.T + t
        images = [camera.image(body) for camera in cameras]
        if not all(((i > 5.0) & (i < np.array(SIZE_PX) - 5.0)).all() for i in images):
            continue
        for name, xy in zip(CAMERAS, images, strict=True):
            seen = xy + noise_px * rng.standard_normal(xy.shape)
            views.append(CalibrationView(name, None, seen, sigma_px=max(noise_px, 1e-3), frame=len(placed)))
        placed.append(body.reshape(-1, 3))
        poses.append((R, t))
    return FreeViews(views, np.array(placed), cameras, poses)


def shape_error_um(pair: StereoPair, cameras: tuple[TrueCamera, TrueCamera], points_mm: Array) -> float:
    """RMS error of points (n, 3) seen by the true cameras, after the best rigid motion."""
    found = pair.triangulate(*(camera.image(points_mm) for camera in cameras)).xyz_mm
    a, b = found - found.mean(axis=0), points_mm - points_mm.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return float(1e3 * np.sqrt(np.mean((a @ u @ vt - b) ** 2)))
