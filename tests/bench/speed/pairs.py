"""The pictures that every program in the bench measures: rendered once, written as TIFF, with truth and calibration.

Two rigs of ``config/``, with OpenCV's lens in place of the paper's, so that every program gets the rig's own calibration
to the last digit: the modern rig's middle 1200 x 1100 px (25 degrees, 39 um a pixel), and the paper's 512 x 480 (60 degrees,
33 um). Noise is 2 of 255, pictures are 8 bit. A speckled plane moves and turns by equal steps, some 0.4 px each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens, SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from tests.bench.accuracy.paper_rig import Rig, load_rig, plane_scene, true_points, turn

NOISE = 2.0  # of 255
STEP_MM = np.array([0.0137, -0.0093, 0.0171])
STEP_TURN_RAD = 2e-4  # about Z_sys, in each step


@dataclass(frozen=True)
class Request:
    """Which rig, where the points lie and how many steps follow the reference.

    ``region_px`` is that of 33 px subsets; others have theirs moved by some pixels, since the peer counts its subsets from
    the picture's corner and both programs shall measure the same points.
    """

    name: str
    config: str
    size_px: tuple[int, int]
    region_px: tuple[int, int, int, int]
    spacing_px: int
    steps: int

    def region(self, subset_px: int) -> tuple[int, int, int, int]:
        """Region (x0, y0, x1, y1) of the points' centres, ends included."""
        x0, y0, x1, y1 = self.region_px
        off = (subset_px // 2 - x0) % self.spacing_px
        assert (subset_px // 2 - y0) % self.spacing_px == off
        return (x0 + off, y0 + off, x1 + off, y1 + off)

    def points(self, subset_px: int) -> Float:
        """Points (N, 2) row by row."""
        x0, y0, x1, y1 = self.region(subset_px)
        x, y = np.meshgrid(np.arange(x0, x1 + 1, self.spacing_px), np.arange(y0, y1 + 1, self.spacing_px))
        return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


MODERN = Request("modern", "sim_modern", (1200, 1100), (76, 106, 1166, 996), 10, 6)
PAPER = Request("paper", "sim_paper", (512, 480), (66, 66, 436, 406), 10, 6)


@dataclass(frozen=True)
class BenchScene:
    """Files and truth of one sequence.

    Attributes
    ----------
    request
        What was asked for.
    pair
        The true cameras; the system frame is the rig's, with the plane at Z = 0.
    cam1, cam2
        Paths, the reference first.
    calibration
        The same cameras as an OpenCV YAML; there the system frame is camera 1's.
    """

    request: Request
    pair: StereoPair
    cam1: list[Path]
    cam2: list[Path]
    calibration: Path

    def truth(self, points_px: Float, steps: int) -> tuple[Float, Float]:
        """True positions (N, 3) at the reference and displacements (steps, N, 3) of camera 1's pixels (N, 2), mm, system frame."""
        texture = load_rig(self.request.config).texture(1)  # does not matter for the truth
        before = plane_scene(texture)
        pairs = [
            true_points(before, plane_scene(texture, motion=motion_of(n)), self.pair.cam1, points_px)
            for n in range(1, steps + 1)
        ]
        return pairs[0][0], np.array([moved for _, moved in pairs])


def opencv_camera(camera: Camera, shift_px: tuple[float, float]) -> Camera:
    """Exchange the paper's lens for OpenCV's with the same main terms, cut to a window that begins at ``shift_px``."""
    lens = camera.lens
    assert isinstance(lens, SeidelLens)
    return Camera(
        OpenCVLens(
            lens.phd_px,
            lens.phd_px * lens.aspect,
            lens.cx_px - shift_px[0],
            lens.cy_px - shift_px[1],
            k1=-lens.kappa_per_px2 * lens.phd_px**2,
            k2=0.02,
            p1=1e-4,
            p2=-1e-4,
        ),
        camera.cam_from_sys,
    )


def bench_rig(request: Request) -> Rig:
    """Return the rig with OpenCV lenses and the window's size."""
    rig = load_rig(request.config)
    shift = tuple((full - cut) / 2 for full, cut in zip(rig.size_px, request.size_px, strict=True))
    cams = [opencv_camera(camera, (shift[0], shift[1])) for camera in (rig.pair.cam1, rig.pair.cam2)]
    return Rig(StereoPair(*cams), request.size_px, rig.speckle_mm, rig.blur_px)


def motion_of(step: int) -> RigidTransform:
    """Where the plane is at a step."""
    turned = turn(np.array([0.0, 0.0, 1.0]), STEP_TURN_RAD * step)
    return RigidTransform(turned.rotation, STEP_MM * step)


def make_scene(request: Request, folder: Path, *, noise: float = NOISE, texture: int = 1) -> BenchScene:
    """Render the sequence into ``folder``."""
    rig = bench_rig(request)
    folder.mkdir(parents=True, exist_ok=True)
    files: tuple[list[Path], list[Path]] = ([], [])
    for n in range(request.steps + 1):
        current = plane_scene(rig.texture(texture), motion=motion_of(n))
        for k, image in enumerate(rig.capture(current, noise=noise, seed=100 * texture + n)):
            path = folder / f"cam{k + 1}_{n:04d}.tif"
            tifffile.imwrite(path, np.clip(np.round(image), 0, 255).astype(np.uint8), photometric="minisblack")
            files[k].append(path)
    calibration = folder / "calibration.yml"
    calibration.write_text(opencv_yaml(rig.pair, request.size_px))
    return BenchScene(request, rig.pair, *files, calibration)


def opencv_yaml(pair: StereoPair, size_px: tuple[int, int]) -> str:
    """Write the pair the way OpenCV's users keep it: plain lists, all digits."""
    lines = ["%YAML:1.0"]
    for k, camera in enumerate((pair.cam1, pair.cam2), start=1):
        lens = camera.lens
        assert isinstance(lens, OpenCVLens)
        K = [[lens.fx_px, lens.skew_px, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
        lines += [f"cameraMatrix{k}: {K!r}", f"distCoeffs{k}: {[lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]!r}"]
    pose = pair.cam2_from_cam1
    lines += [f"R: {pose.rotation.tolist()!r}", f"T: {pose.translation_mm.tolist()!r}", f"imageSize: {list(size_px)!r}"]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Errors:
    """What a program's fields are worth: means and scatters over points, micrometres; scatter pooled over the steps.

    Attributes
    ----------
    lost
        Points without a result, worst step.
    mean_um, sd_um
        (4,) of u, v, w and Z, system frame; ``mean_um`` of the worst step, with its sign.
    """

    lost: int
    mean_um: Float
    sd_um: Float

    @property
    def sd3_um(self) -> float:
        """Length of the displacement's scatter, one figure for plots."""
        return float(np.linalg.norm(self.sd_um[:3]))


def compare(scene: BenchScene, points_px: Float, xyz_cam1_mm: Float, uvw_cam1_mm: Float) -> Errors:
    """Compare fields in camera 1's frame, (N, 3) and (steps, N, 3) with NaN where lost, with the truth at its pixels (N, 2)."""
    xyz, moved = scene.truth(points_px, len(uvw_cam1_mm))
    to_sys = scene.pair.cam1.sys_from_cam
    z = (to_sys.apply(xyz_cam1_mm) - xyz)[:, 2] * 1e3
    error = (uvw_cam1_mm @ to_sys.rotation.T - moved) * 1e3
    found = np.isfinite(error).all(axis=2)
    steps = [e[f] for e, f in zip(error, found, strict=True)]
    if min(map(len, steps)) < 2 or np.isfinite(z).sum() < 2:
        raise ValueError("a step without two measured points has no scatter")
    means = np.array([e.mean(axis=0) for e in steps])
    worst = means[np.abs(means).argmax(axis=0), np.arange(3)]
    pooled = np.sqrt(np.mean([e.var(axis=0) for e in steps], axis=0))
    z = z[np.isfinite(z)]
    return Errors(found.shape[1] - int(found.sum(axis=1).min()), np.append(worst, z.mean()), np.append(pooled, z.std()))
