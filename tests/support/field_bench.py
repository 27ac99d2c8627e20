"""A small simulated rig for field tests: the paper's, with the images cut down to their middle."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.truth import Truth, truth_at
from tests.support.requirements import ROOT

SIZE = (264, 225)  # columns, rows; multiples of three
_CORNER = (124.0, 128.0)

Images = tuple[NDArray[np.uint8], NDArray[np.uint8]]


@lru_cache(maxsize=1)
def rig() -> SimRig:
    return SimRig.from_toml(ROOT / "config" / "sim_paper.toml")


def _cut(camera: Camera) -> Camera:
    lens = camera.lens
    assert isinstance(lens, SeidelLens)
    return replace(camera, lens=replace(lens, cx_px=lens.cx_px - _CORNER[0], cy_px=lens.cy_px - _CORNER[1]))


@lru_cache(maxsize=1)
def pair() -> StereoPair:
    return StereoPair(_cut(rig().cam1.camera), _cut(rig().cam2.camera))


@lru_cache(maxsize=32)
def scene(name: str, load: float = 0.0, motion: tuple[float, ...] | None = None) -> Scene:
    more = {} if motion is None else {"translation_mm": motion[:3], "rotation_rad": motion[3:]}
    return make_scene(rig(), name, load=load, **more)


@lru_cache(maxsize=32)
def _brightness(name: str, load: float, motion: tuple[float, ...] | None) -> tuple[NDArray[np.float32], ...]:
    cameras = pair()
    options = RenderOptions(blur_px=rig().blur_px)
    return tuple(
        render(scene(name, load, motion), camera, SIZE, options=options) for camera in (cameras.cam1, cameras.cam2)
    )


def take(
    name: str, load: float = 0.0, motion: tuple[float, ...] | None = None, *, seed: int = 0, noise: float = 2.0
) -> Images:
    """Expose both cameras: 8 bit, with white noise of ``noise`` grey levels."""
    rng = np.random.default_rng([seed, round(100 * load)])
    first, second = (
        np.clip(np.rint(255.0 * b + noise * rng.standard_normal(b.shape)), 0, 255).astype(np.uint8)
        for b in _brightness(name, load, motion)
    )
    return first, second


def grid(*, spacing_px: float = 8.0, margin_px: float = 36.0) -> PointGrid:
    return PointGrid.rectangle(
        margin_px, margin_px, SIZE[0] - 1 - margin_px, SIZE[1] - 1 - margin_px, spacing_px=spacing_px
    )


def truth(points: PointGrid, reference: Scene, now: Scene | None = None) -> Truth:
    return truth_at(reference, pair().cam1, points.xy_px, now=now)
