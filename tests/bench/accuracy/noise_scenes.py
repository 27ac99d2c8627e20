"""Small windows of the simulated rigs on a speckled plane, with the exact unknowns of every point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.texture import speckle
from tests.bench.accuracy.paper_rig import BRIGHT, DARK, load_rig, plane_scene

RIGS = {"paper": "sim_paper", "modern": "sim_modern"}
GAINS = (1.0, 0.88)


@dataclass(frozen=True)
class Appearance:
    """A texture as the cameras see it: speckle and rim in px, blur in px, contrast."""

    speckle_px: float = 4.0
    rim: float = 0.35  # of the diameter
    blur_px: float = 0.7
    contrast: float = 1.0


APPEARANCES = {
    "standard": Appearance(),
    "coarse": Appearance(speckle_px=8.0, blur_px=1.1),
    "fine": Appearance(speckle_px=3.0),
    "sharp": Appearance(rim=0.2, blur_px=0.4),
    "low contrast": Appearance(contrast=0.5),
}


class Window:
    """Both cameras' windows about the system's origin, before and after a translation of the plane.

    Parameters
    ----------
    rig
        ``paper`` (60 degrees) or ``modern`` (25 degrees).
    look
        One of APPEARANCES.
    size_px
        Width and height.
    seed
        Of the speckle.
    """

    def __init__(
        self, rig: str = "paper", appearance: Appearance = APPEARANCES["standard"], *, size_px: int = 300, seed: int = 1
    ) -> None:
        full = load_rig(RIGS[rig])
        self.appearance, self.size_px = appearance, size_px
        self.pair = StereoPair(*(self._window(camera) for camera in (full.pair.cam1, full.pair.cam2)))
        phd, z = self.pair.cam1.paper_parameters()["phd_px"], self.pair.cam1.paper_parameters()["z0_mm"]
        self.mm_per_px = z / phd
        d = appearance.speckle_px * self.mm_per_px
        self.texture = speckle(diameter_mm=d, seed=seed, rim_mm=appearance.rim * d)

    def _window(self, camera: Camera) -> Camera:
        lens = camera.lens
        assert isinstance(lens, SeidelLens)
        at = np.round(camera.project(np.zeros(3)).xy) - self.size_px // 2
        return Camera(replace(lens, cx_px=lens.cx_px - at[0], cy_px=lens.cy_px - at[1]), camera.cam_from_sys)

    def shift_mm(self, dx_px: float, dy_px: float = 0.0) -> Float:
        """Translation in the plane that moves camera 1's image by (dx, dy) px at the window's middle."""
        middle = np.full(2, 0.5 * (self.size_px - 1))
        points = self.pair.cam1.back_project_to_plane(np.stack([middle, middle + np.array([dx_px, dy_px])])).xyz_mm
        return np.asarray(points[1] - points[0])

    def clean(self, shift_mm: Float | None = None) -> list[Float]:
        """Grey levels of both cameras without noise, the plane moved by ``shift_mm``."""
        motion = None if shift_mm is None else RigidTransform(np.eye(3), np.asarray(shift_mm))
        scene = plane_scene(self.texture, motion=motion)
        size = (self.size_px, self.size_px)
        options = RenderOptions(blur_px=self.appearance.blur_px, threads=2)
        middle = 0.5 * (DARK + BRIGHT)
        return [
            middle
            + self.appearance.contrast
            * (gain * (DARK + (BRIGHT - DARK) * render(scene, camera, size, options=options)) - middle)
            for gain, camera in zip(GAINS, (self.pair.cam1, self.pair.cam2), strict=True)
        ]

    def points(self, subset_px: int, margin: int = 8) -> Float:
        """Points (N, 2) at whole pixels whose subsets do not overlap."""
        start = subset_px // 2 + margin
        v = np.arange(start, self.size_px - start, subset_px)
        x, y = np.meshgrid(v, v)
        return np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64)

    def unknowns(self, xy: Float, shift_mm: Float | None = None) -> tuple[Float, Float]:
        """True w (N, 3) and G (N, 3, 3): the plane is Z_sys = 0, so both are closed forms."""
        pose = self.pair.cam1.cam_from_sys
        normal = pose.rotation[:, 2]
        d = normal @ pose.translation_mm
        rays = self.pair.cam1.rays_cam(xy).xyz_mm
        w = np.empty((len(xy), 3))
        w[:, 0] = rays @ normal / d
        w[:, 1:] = normal[:2] / d
        # a point at ray / w moves by t: G (1, X, Y) = ray + w(X, Y) t
        t = np.zeros(3) if shift_mm is None else pose.rotation @ shift_mm
        G = w[:, None, :] * t[:, None]
        G[:, :, 0] += rays
        G[:, 0, 1] += 1.0
        G[:, 1, 2] += 1.0
        return w, G

    def displacement(self, xy: Float, w: Float, G: Float) -> Float:
        """u, v, w (N, 3) in mm of unknowns, system frame."""
        rays = self.pair.cam1.rays_cam(xy).xyz_mm
        return np.asarray((G[:, :, 0] - rays) / w[:, :1] @ self.pair.cam1.cam_from_sys.rotation)

    def height(self, xy: Float, w: Float) -> Float:
        """Z_sys (N,) in mm."""
        rays = self.pair.cam1.rays_cam(xy).xyz_mm
        return np.asarray(self.pair.cam1.sys_from_cam.apply(rays / w[:, :1])[:, 2])


def digitise(clean: list[Float], noise: float, rng: np.random.Generator) -> list[NDArray[np.uint8]]:
    """Noise of one sd everywhere, and eight bits."""
    return [np.clip(np.rint(c + rng.normal(0.0, noise, c.shape)), 0, 255).astype(np.uint8) for c in clean]
