"""Stereo rigs before boards, level of points: OpenCV's projection is the truth, nothing of the calibration is used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationView
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

Array = NDArray[np.float64]
LENSES: dict[str, tuple[float, ...]] = {
    "pinhole": (0.0, 0.0, 0.0, 0.0, 0.0),
    "k1 k2": (-0.05, 0.02, 0.0, 0.0, 0.0),
    "p1 p2 of 1e-4": (-0.05, 0.0, 1e-4, -1.5e-4, 0.0),
    "p1 p2 of 3e-4": (-0.05, 0.02, 2e-4, -3e-4, 0.0),
}
_MARGIN_PX = 5.0
_RIM = 360  # points of a dot's outline


@dataclass(frozen=True)
class TrueCamera:
    """One camera of a built rig.

    Attributes
    ----------
    size_px
        (width, height).
    K
        (3, 3) camera matrix.
    lens
        OpenCV's coefficients (5, 8, 12 or 14), or four of its fisheye model.
    R, t_mm
        From the system frame to the camera's.
    fisheye
        True for OpenCV's fisheye model.
    """

    size_px: tuple[int, int]
    K: Array
    lens: tuple[float, ...]
    R: Array
    t_mm: Array
    fisheye: bool = False

    def project(self, points_mm: Array) -> Array:
        """Return the images (..., 2) of points (..., 3) of the system frame, by OpenCV."""
        p = np.ascontiguousarray((points_mm @ self.R.T + self.t_mm).reshape(-1, 1, 3))
        none = np.zeros(3)
        if self.fisheye:
            image = cv2.fisheye.projectPoints(p, none, none, self.K, np.array(self.lens))[0]
        else:
            image = cv2.projectPoints(p, none, none, self.K, np.array(self.lens))[0]
        return np.asarray(image, dtype=np.float64).reshape(*points_mm.shape[:-1], 2)

    def moved(self, shift_mm: Array, turn: Array | None = None) -> TrueCamera:
        """Return the camera with its view of the world shifted in its own frame, and turned first."""
        R = np.eye(3) if turn is None else Rotation.from_rotvec(turn).as_matrix()
        return replace(self, R=R @ self.R, t_mm=R @ self.t_mm + shift_mm)

    def sees(self, image_px: Array) -> NDArray[np.bool_]:
        """Return (...) True where an image lies within the picture."""
        inside = (image_px >= _MARGIN_PX) & (image_px <= np.array(self.size_px) - 1.0 - _MARGIN_PX)
        return np.asarray(inside.all(axis=-1))


def rotation(alpha: float, beta: float, gamma: float) -> Array:
    """Eq. (1) of the method's page, typed from there."""
    sa, ca, sb, cb, sg, cg = np.sin(alpha), np.cos(alpha), np.sin(beta), np.cos(beta), np.sin(gamma), np.cos(gamma)
    return np.array(
        [
            [ca * cg, -sa * cg, sg],
            [sa * cb + ca * sg * sb, ca * cb - sa * sg * sb, -cg * sb],
            [sa * sb - ca * sg * cb, ca * sb + sa * sg * cb, cg * cb],
        ]
    )


def ordinary_pair(
    lens: tuple[float, ...],
    *,
    angle_deg: float = 25.0,
    roll_deg: float = 2.0,
    size_px: tuple[int, int] = (2448, 2048),
    focal_px: float = 3500.0,
    centre_px: tuple[float, float] = (1230.0, 1010.0),
    standoff_mm: float = 350.0,
) -> tuple[TrueCamera, TrueCamera]:
    """Return two cameras alike at either side of a target."""
    K = np.array([[focal_px, 0.0, centre_px[0]], [0.0, focal_px, centre_px[1]], [0.0, 0.0, 1.0]])
    t = np.array([1.0, -2.0, standoff_mm])
    one, two = (
        TrueCamera(size_px, K, lens, rotation(np.radians(roll_deg), 0.005, np.radians(g)), t)
        for g in (-0.5 * angle_deg, 0.5 * angle_deg)
    )
    return one, two


def flat(points_mm: Array) -> Array:
    """Return (n_a, n_b, 3) of points in the target's plane."""
    return np.concatenate([points_mm, np.zeros((*points_mm.shape[:-1], 1))], axis=-1)


def made(
    points_mm: Array, rng: np.random.Generator, *, tolerance_mm: float = 0.0, bow_mm: float = 0.0, axes: int = 3
) -> Array:
    """Return a target as it was made: uniform errors within a tolerance, bowed to a paraboloid along X."""
    P = flat(points_mm)
    P[..., :axes] += rng.uniform(-tolerance_mm, tolerance_mm, P[..., :axes].shape)
    u = points_mm / np.abs(points_mm).max(axis=(0, 1))
    P[..., 2] += bow_mm * u[..., 0] ** 2
    return P


@dataclass(frozen=True)
class Pose:
    """Pose of the target in the system frame."""

    R: Array
    t_mm: Array

    def of(self, points_mm: Array) -> Array:
        """Return the points (..., 3) in the system frame."""
        return np.asarray(points_mm @ self.R.T + self.t_mm)


def hand_held(
    rng: np.random.Generator,
    cameras: Sequence[TrueCamera],
    points_mm: Array,
    n: int,
    *,
    tilt_deg: float = 35.0,
    span_mm: float = 60.0,
    turn_deg: float = 25.0,
    least_share: float = 1.0,
) -> list[Pose]:
    """Return poses as a hand shows a board, those that both cameras see to at least a share."""
    poses: list[Pose] = []
    for _ in range(400 * n):
        way = rng.uniform(0.0, 2.0 * np.pi)
        tilt = rng.uniform(0.2, 1.0) * np.radians(tilt_deg)
        turn = Rotation.from_euler("z", rng.uniform(-turn_deg, turn_deg), degrees=True).as_matrix()
        R = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0.0])).as_matrix() @ turn
        t = rng.uniform(-1.0, 1.0, 3) * np.array([0.6, 0.5, 1.0]) * span_mm
        pose = Pose(R, t)
        if all(c.sees(c.project(pose.of(points_mm))).mean() >= least_share for c in cameras):
            poses.append(pose)
            if len(poses) == n:
                return poses
    raise ValueError(f"both cameras see {len(poses)} of {n} poses")


def observed(
    camera: TrueCamera, points_mm: Array, rng: np.random.Generator, noise_px: float, dot_radius_mm: float | None = None
) -> Array:
    """Return the places (n_a, n_b, 2) that a localiser finds; of dots the centroids of their imaged discs."""
    image = camera.project(points_mm) if dot_radius_mm is None else centroids(camera, points_mm, dot_radius_mm)
    found = np.where(camera.sees(image)[..., None], image, np.nan)
    return np.asarray(found + noise_px * rng.standard_normal(image.shape))


def centroids(camera: TrueCamera, points_mm: Array, radius_mm: float) -> Array:
    """Centroids of imaged discs that lie in the plane of a field of points, by the polygon of their outlines."""
    ex = points_mm[-1, 0] - points_mm[0, 0]
    ey = points_mm[0, -1] - points_mm[0, 0]
    ex = ex / np.linalg.norm(ex)
    ey = ey - ex * (ex @ ey)
    ey = ey / np.linalg.norm(ey)
    a = 2.0 * np.pi * np.arange(_RIM) / _RIM
    ring = radius_mm * (np.cos(a)[:, None] * ex + np.sin(a)[:, None] * ey)
    rim = camera.project(points_mm[..., None, :] + ring)
    middle = rim.mean(axis=-2, keepdims=True)
    p = rim - middle
    q = np.roll(p, -1, axis=-2)
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return np.asarray(
        middle[..., 0, :] + ((p + q) * cross[..., None]).sum(axis=-2) / (3.0 * cross.sum(axis=-1))[..., None]
    )


def views_of_poses(
    cameras: Sequence[TrueCamera],
    points_mm: Array,
    poses: Sequence[Pose],
    rng: np.random.Generator,
    noise_px: float,
    *,
    first: int = 0,
    dot_radius_mm: float | None = None,
) -> list[CalibrationView]:
    """Return both cameras' views of a target in free poses."""
    views = []
    for k, pose in enumerate(poses):
        for name, camera in zip(CAMERAS, cameras, strict=True):
            xy = observed(camera, pose.of(points_mm), rng, noise_px, dot_radius_mm)
            views.append(
                CalibrationView(name, None, xy, frame=first + k, sigma_px=noise_px, dot_radius_mm=dot_radius_mm)
            )
    return views


def aligned_rms_um(got_mm: Array, true_mm: Array) -> float:
    """Error of a shape: rms a coordinate after the best rigid motion."""
    a, b = got_mm - got_mm.mean(axis=0), true_mm - true_mm.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return 1e3 * float(np.sqrt(np.mean((a @ turn - b) ** 2)))


def seen_from(pose: Pose, cameras: Sequence[TrueCamera]) -> list[TrueCamera]:
    """Return the cameras in the system frame that a pose of the target defines."""
    return [replace(c, R=c.R @ pose.R, t_mm=c.R @ pose.t_mm + c.t_mm) for c in cameras]


def shape_error_um(pair: StereoPair, cameras: Sequence[TrueCamera], points_mm: Array) -> float:
    """Error of the shape of points (n, 3) that a calibrated pair finds where the true cameras see them."""
    xyz = pair.triangulate(*(c.project(points_mm) for c in cameras)).xyz_mm
    return aligned_rms_um(xyz, points_mm)


def rms(values: Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def by_frame(views: Sequence[CalibrationView]) -> dict[str, list[Array]]:
    """Each camera's points by the frames that both cameras saw whole, (n, 2) each."""
    frames = sorted({v.frame for v in views if v.frame is not None})
    per = {n: {v.frame: v.xy_px for v in views if v.camera == n} for n in CAMERAS}
    return {n: [per[n][k] for k in frames] for n in CAMERAS}


@dataclass(frozen=True)
class OpenCVResult:
    """What cv2.stereoCalibrate found: matrices, coefficients, relative pose, poses of the board in camera 1."""

    K: tuple[Array, Array]
    lens: tuple[Array, Array]
    R: Array
    T: Array
    rvecs: Array
    tvecs: Array

    @property
    def pair(self) -> StereoPair:
        """The cameras, system frame that of camera 1."""
        return opencv_pair(self.K, self.lens, self.R, self.T)


def opencv_pair(K: Sequence[Array], lens: Sequence[Array], R: Array, T: Array) -> StereoPair:
    """Return a pair from OpenCV's numbers, up to its eight-term lens."""
    lenses = []
    for k, d in zip(K, lens, strict=True):
        terms = np.zeros(8)
        terms[: min(len(d.ravel()), 8)] = d.ravel()[:8]
        more = dict(zip(("k4", "k5", "k6"), terms[5:], strict=True))
        lenses.append(OpenCVLens(k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0.0, *terms[:5], **more))
    return StereoPair(
        Camera(lenses[0], RigidTransform(np.eye(3), np.zeros(3))), Camera(lenses[1], RigidTransform(R, T.ravel()))
    )


def stereo_calibrate(
    views: Sequence[CalibrationView], points_mm: Array, size_px: tuple[int, int], *, flags: int = 0
) -> OpenCVResult:
    """Calibrate by OpenCV as its documents advise: each camera first, then both with these as a start."""
    images = by_frame(views)
    n = len(images["cam1"])
    objects = [flat(points_mm).reshape(-1, 3).astype(np.float32)] * n
    corners = {c: [xy.reshape(-1, 1, 2).astype(np.float32) for xy in images[c]] for c in CAMERAS}
    starts = [cv2.calibrateCamera(objects, corners[c], size_px, None, None, flags=flags)[1:3] for c in CAMERAS]
    found = cv2.stereoCalibrateExtended(
        objects,
        corners["cam1"],
        corners["cam2"],
        starts[0][0],
        starts[0][1],
        starts[1][0],
        starts[1][1],
        size_px,
        np.eye(3),
        np.zeros((3, 1)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9),
    )
    _, K1, d1, K2, d2, R, T, _, _, rvecs, tvecs, _ = found
    return OpenCVResult(
        (K1, K2), (d1, d2), R, T, np.array([r.ravel() for r in rvecs]), np.array([t.ravel() for t in tvecs])
    )


def checkerboard(tolerance_mm: float = 0.0) -> BoardTarget:
    """A board of 9 x 7 inner corners that half fills the ordinary pair's images."""
    return BoardTarget(kind="checkerboard", size=(9, 7), pitch_mm=14.0, node_tolerance_mm=tolerance_mm)
