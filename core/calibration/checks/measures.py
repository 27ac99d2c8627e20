"""Error measures in the paper's form, Eqs. (15) to (17)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import LensModel, OpenCVLens, SeidelLens


@dataclass(frozen=True)
class Measures:
    """RAZ, NSCE and RBE over ``count`` points."""

    rbe_px: float
    raz_mm: float
    nsce: float
    count: int


@dataclass(frozen=True)
class CheckMeasures:
    """Measures of both cameras: their mean, and each camera's own.

    Attributes
    ----------
    mean, per_camera
        Relative to the nodes that the calibration used (corrected ones if it estimated corrections).
    nominal_mean, nominal_per_camera
        Relative to the nominal grid.
    positions_mm
        Stage positions that entered, ascending, per camera.
    frames
        Numbers of the free poses that entered, per camera.
    """

    mean: Measures
    per_camera: tuple[Measures, Measures]
    nominal_mean: Measures
    nominal_per_camera: tuple[Measures, Measures]
    positions_mm: tuple[tuple[float, ...], tuple[float, ...]]
    frames: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())


def measure_points(camera: Camera, points_mm: Float, xy_px: Float) -> Measures:
    """Compute RAZ (15), NSCE (16) and RBE (17) of one camera over points (n, 3), (n, 2) of a plane target.

    The camera's pose is that towards the target, so that the target's plane is Z = 0. Points without an image or
    without a ray count as infinite error: a calibration that loses points is not better.
    """
    f_u, f_v = focal_lengths_px(camera.lens)
    image = camera.project(points_mm)
    back = camera.back_project_to_plane(xy_px, point_sys_mm=points_mm)
    lost = ~(image.valid & back.valid)
    rbe = np.where(lost, np.inf, np.linalg.norm(xy_px - image.xy, axis=-1))
    raz = np.where(lost, np.inf, np.linalg.norm((points_mm - back.xyz_mm)[..., :2], axis=-1))
    truth_cam, found_cam = camera.cam_from_sys.apply(points_mm), camera.cam_from_sys.apply(back.xyz_mm)
    across = np.sum((truth_cam - found_cam)[..., :2] ** 2, axis=-1)
    nsce = np.where(lost, np.inf, np.sqrt(across / (found_cam[..., 2] ** 2 * (f_u**-2 + f_v**-2) / 12.0)))
    return Measures(float(rbe.mean()), float(raz.mean()), float(nsce.mean()), int(rbe.size))


def focal_lengths_px(lens: LensModel) -> tuple[float, float]:
    """Return f_u and f_v of Eq. (16): along the rows and the columns."""
    if isinstance(lens, SeidelLens):
        return lens.phd_px, lens.aspect * lens.phd_px
    if isinstance(lens, OpenCVLens):
        return lens.fx_px, lens.fy_px
    raise TypeError(f"a {type(lens).__name__} has no pinhole distance")


def pooled(parts: Sequence[Measures]) -> Measures:
    """Measures over all points of several sets."""
    n = np.array([p.count for p in parts], dtype=np.float64)
    total = float(n.sum())
    return Measures(
        float(n @ [p.rbe_px for p in parts]) / total,
        float(n @ [p.raz_mm for p in parts]) / total,
        float(n @ [p.nsce for p in parts]) / total,
        int(total),
    )


def mean_of_cameras(per_camera: tuple[Measures, Measures]) -> Measures:
    """Plain mean of the two cameras' figures."""
    a, b = per_camera
    return Measures(
        0.5 * (a.rbe_px + b.rbe_px), 0.5 * (a.raz_mm + b.raz_mm), 0.5 * (a.nsce + b.nsce), a.count + b.count
    )
