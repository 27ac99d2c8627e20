"""mrcal as a witness: the same views calibrated by it (from Debian's packages), and what it says of points."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stereorig.core.calibration import CalibrationView
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from tests.support.calibration_rigs import Array, OpenCVResult, by_frame, opencv_pair

PYTHON = "/usr/bin/python3"
PROGRAM = Path(__file__).with_name("mrcal_program.py")
PACKAGES = "mrcal (apt-get install mrcal python3-mrcal)"


def mrcal_is_there() -> bool:
    """Return True if Debian's Python has mrcal."""
    try:
        return subprocess.run([PYTHON, "-c", "import mrcal"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


@dataclass(frozen=True)
class MrcalResult:
    """What mrcal found: (2, n) intrinsics, camera 2's pose (6,), and the covariance of these in this order."""

    intrinsics: Array
    rt21: Array
    covariance: Array

    @property
    def pair(self) -> StereoPair:
        """The cameras, system frame that of camera 1."""
        K = [np.array([[i[0], 0.0, i[2]], [0.0, i[1], i[3]], [0.0, 0.0, 1.0]]) for i in self.intrinsics]
        return opencv_pair(K, [i[4:] for i in self.intrinsics], cv2.Rodrigues(self.rt21[:3])[0], self.rt21[3:])


def calibrate_by_mrcal(
    views: Sequence[CalibrationView],
    pitch_mm: float,
    sizes_px: Sequence[tuple[int, int]],
    start: OpenCVResult,
    *,
    lensmodel: str = "LENSMODEL_OPENCV5",
    noise_px: Sequence[float] = (1.0, 1.0),
    warp: bool = False,
) -> MrcalResult:
    """Calibrate by mrcal without regularisation and without its rejection of outliers.

    Parameters
    ----------
    views
        Free poses of a board, wholly seen.
    pitch_mm, sizes_px
        The board's, and the cameras'.
    start
        OpenCV's result.
    lensmodel
        mrcal's name of the lens.
    noise_px
        Of each camera; weighs its observations.
    warp
        True to let mrcal fit its two terms of a bowed board.
    """
    images = by_frame(views)
    n_lens = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5, "LENSMODEL_OPENCV8": 8}[lensmodel]
    intrinsics = []
    for K, d in zip(start.K, start.lens, strict=True):
        terms = np.zeros(n_lens)
        shared = min(n_lens, len(d.ravel()))
        terms[:shared] = d.ravel()[:shared]
        intrinsics.append([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *terms])
    # mrcal counts from the first corner
    one = images["cam1"][0]
    shift = -0.5 * pitch_mm * np.array([one.shape[0] - 1.0, one.shape[1] - 1.0, 0.0])
    frames = [
        np.concatenate([r, cv2.Rodrigues(r)[0] @ shift + t]) for r, t in zip(start.rvecs, start.tvecs, strict=True)
    ]
    observations = []
    for k in range(len(frames)):
        for c, name in enumerate(CAMERAS):
            xy = images[name][k].swapaxes(0, 1)  # rows, columns
            observations.append(np.concatenate([xy, np.full((*xy.shape[:2], 1), 1.0 / noise_px[c])], axis=-1))
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(
            given,
            lensmodel=lensmodel,
            intrinsics=np.array(intrinsics),
            rt21=np.concatenate([cv2.Rodrigues(start.R)[0].ravel(), start.T.ravel()]),
            frames=np.array(frames),
            observations=np.array(observations),
            spacing=pitch_mm,
            sizes=np.array(sizes_px),
            warp=warp,
        )
        done = subprocess.run(
            [PYTHON, str(PROGRAM), str(given), str(found)], capture_output=True, check=False, text=True
        )
        if done.returncode:
            raise RuntimeError(f"mrcal: {done.stderr[-500:]}")
        with np.load(found) as data:
            return MrcalResult(data["intrinsics"], data["rt21"], data["covariance"])


def shape_sigma_um(result: MrcalResult, points_mm: Array) -> float:
    """Shape uncertainty of points (n, 3) in camera 1's frame by mrcal's covariance, without the rigid motion.

    The derivatives are OpenCV's; triangulation as least squares of the images.
    """
    n, n_lens = len(points_mm), result.intrinsics.shape[1] - 4
    size = len(result.covariance)
    A, B = np.zeros((n, 4, 3)), np.zeros((n, 4, size))
    for c, (i, rt) in enumerate(zip(result.intrinsics, (np.zeros(6), result.rt21), strict=True)):
        K = np.array([[i[0], 0.0, i[2]], [0.0, i[1], i[3]], [0.0, 0.0, 1.0]])
        d = i[4:] if n_lens else np.zeros(5)
        _, J = cv2.projectPoints(points_mm.reshape(-1, 1, 3), rt[:3], rt[3:], K, d)
        J = J.reshape(n, 2, -1)
        rows = slice(2 * c, 2 * c + 2)
        A[:, rows] = J[..., 3:6] @ cv2.Rodrigues(rt[:3])[0]
        own = c * (4 + n_lens)
        B[:, rows, own : own + 4 + n_lens] = J[..., 6 : 10 + n_lens]
        if c:
            B[:, rows, -6:] = J[..., :6]
    At = np.swapaxes(A, 1, 2)
    G = (-np.linalg.solve(At @ A, At @ B)).reshape(3 * n, size)
    motions = np.zeros((n, 3, 6))
    motions[:, range(3), range(3)] = 1.0
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], points_mm - points_mm.mean(axis=0))
    design = motions.reshape(-1, 6)
    G = G - design @ np.linalg.lstsq(design, G, rcond=None)[0]
    return 1e3 * float(np.sqrt(np.einsum("ip,pq,iq->", G, result.covariance, G, optimize=True) / len(G)))


def ray_slopes(result: MrcalResult, points_mm: Array) -> Array:
    """Derivatives (n, 3, p) of points, camera 1's frame, over the parameters of mrcal's covariance, images held.

    A point stays on camera 1's ray of its pixel, where camera 2 sees it nearest to its pixel along the epipolar line.
    The images and their derivatives are OpenCV's, by differences.
    """

    def seen(k: int, x: Array, points: Array) -> Array:
        n_lens = result.intrinsics.shape[1]
        i = x[k * n_lens : (k + 1) * n_lens]
        rt = np.zeros(6) if k == 0 else x[2 * n_lens :]
        K = np.array([[i[0], 0.0, i[2]], [0.0, i[1], i[3]], [0.0, 0.0, 1.0]])
        d = i[4:] if n_lens > 4 else np.zeros(5)
        return np.asarray(cv2.projectPoints(points.reshape(-1, 1, 3), rt[:3], rt[3:], K, d)[0].reshape(-1, 2))

    x0 = np.concatenate([result.intrinsics.ravel(), result.rt21])
    pixels = [seen(k, x0, points_mm) for k in range(2)]
    ahead = seen(1, x0, points_mm * 1.001) - seen(1, x0, points_mm * 0.999)
    along = ahead / np.linalg.norm(ahead, axis=1)[:, None]

    def measured(x: Array) -> Array:
        point = points_mm.copy()
        for _ in range(4):
            # the ray: two coordinates by camera 1's image at this depth
            step = 1e-3 * point[:, 2:]
            gx, gy = (
                (seen(0, x, point + step * axis) - seen(0, x, point - step * axis)) / (2.0 * step)
                for axis in np.eye(3)[:2]
            )
            miss = pixels[0] - seen(0, x, point)
            point[:, :2] += np.linalg.solve(np.stack([gx, gy], axis=-1), miss[..., None])[..., 0]
            miss1 = ((pixels[1] - seen(1, x, point)) * along).sum(axis=1)
            slope = ((seen(1, x, point * 1.0005) - seen(1, x, point * 0.9995)) * along).sum(axis=1) / 1e-3
            point *= (1.0 + miss1 / slope)[:, None]
        return point

    out = np.empty((len(points_mm), 3, len(x0)))
    for k, sd in enumerate(np.sqrt(np.diagonal(result.covariance))):
        step = 0.1 * float(sd)
        e = np.zeros(len(x0))
        e[k] = step
        out[..., k] = (measured(x0 + e) - measured(x0 - e)) / (2.0 * step)
    return out
