"""The simulated rigs as the accuracy script uses them: true cameras, scenes, pictures with a stated noise."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import ELEVEN_PARAMETER_NAMES, Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.sim.render import RenderOptions, material_points, render
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import flat
from stereorig.sim.texture import Texture, speckle
from tests.support.requirements import ROOT

DARK, BRIGHT = 20.0, 235.0  # grey levels of brightness 0 and 1, of 255


@dataclass(frozen=True)
class Rig:
    """True cameras of a rig file, and its picture size."""

    pair: StereoPair
    size_px: tuple[int, int]
    speckle_mm: float
    blur_px: float

    def texture(self, seed: int = 1) -> Texture:
        return speckle(diameter_mm=self.speckle_mm, seed=seed)

    def capture(
        self, scene: Scene, *, noise: float = 2.0, seed: int = 0, cam: int | None = None, dz_mm: float = 0.0
    ) -> list[NDArray[np.uint8]] | list[Float]:
        """Pictures of both cameras, 8 bit with noise; unrounded where noise is 0, so that nothing but the method shows."""
        rng = np.random.default_rng(seed)
        out = []
        for k, camera in enumerate((self.pair.cam1, self.pair.cam2)):
            if cam is not None and k != cam:
                continue
            clean = render(
                scene, camera.moved(dz_mm), self.size_px, options=RenderOptions(blur_px=self.blur_px, threads=2)
            )
            grey = DARK + (BRIGHT - DARK) * clean * (1.0 if k == 0 else 0.88)
            if noise:
                out.append(np.clip(np.round(grey + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8))
            else:
                out.append(grey)
        return out


def load_rig(name: str = "sim_paper") -> Rig:
    """Read the true cameras of ``config/<name>.toml``."""
    table = tomllib.loads((ROOT / "config" / f"{name}.toml").read_text())
    sim = table["sim"]
    cams = [Camera.from_paper(**{k: sim[c][k] for k in ELEVEN_PARAMETER_NAMES}) for c in ("cam1", "cam2")]
    width, height = table["cam1"]["image_size_px"]
    return Rig(StereoPair(*cams), (width, height), sim["speckle_mm"], sim["blur_px"])


def plane_scene(texture: Texture, *, in_plane: Float | None = None, motion: RigidTransform | None = None) -> Scene:
    """A speckled plane near Z_sys = 0, stretched by ``in_plane`` (2, 2) and then moved by ``motion`` (system frame)."""
    surface = flat() if in_plane is None else flat(in_plane)
    pose = UPRIGHT if motion is None else motion @ UPRIGHT
    return Scene(name="plane", surface=surface, texture=texture, sys_from_body=pose)


def true_points(scene: Scene, moved: Scene, camera: Camera, xy_px: Float) -> tuple[Float, Float]:
    """Reference positions and displacements (..., 3), system frame, of the material that camera 1's pixels see."""
    st, lip = material_points(scene, camera, xy_px)
    here = scene.sys_from_body.apply(scene.surface.positions(st, lip))
    there = moved.sys_from_body.apply(moved.surface.positions(st, lip))
    return here, there - here


def turn(axis: Float, angle_rad: float, about_mm: Float | None = None) -> RigidTransform:
    """Rotation about an axis of the system frame through ``about_mm``."""
    n = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    K = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    R = np.eye(3) + np.sin(angle_rad) * K + (1 - np.cos(angle_rad)) * K @ K
    c = np.zeros(3) if about_mm is None else np.asarray(about_mm)
    return RigidTransform(R, c - R @ c)
