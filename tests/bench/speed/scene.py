"""Pictures for the benchmarks: a rendered pair of the modern rig's cameras, cut or widened to a size, and a sequence.

A speckled plane is stretched, turned and moved a little more in each step, some 0.7 px a step in the images. Files are
rendered once into a folder and used again from there.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stereorig.core.calibration import CalibrationOptions, NominalValues
from stereorig.core.calibration.expect import expect
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from stereorig.server.formats.images import encode_tiff
from stereorig.sim.scene import Scene
from tests.bench.accuracy.paper_rig import Rig, load_rig, plane_scene, turn

SEQUENCE_SIZE = (1200, 1100)
NOISE = 2.0


def rig_of_size(size_px: tuple[int, int], *, name: str = "sim_modern") -> Rig:
    """The modern rig with sensors of another size about the same centre."""
    rig = load_rig(name)

    def resized(camera: Camera) -> Camera:
        lens = camera.lens
        assert isinstance(lens, SeidelLens)
        shift = (np.array(size_px) - np.array(rig.size_px)) / 2.0
        # a wider sensor would leave the radius up to which Eq. (6) holds: the lens keeps its distortion at the corner
        shrink = min(1.0, (np.hypot(*rig.size_px) / np.hypot(*size_px)) ** 2)
        return replace(
            camera,
            lens=replace(
                lens,
                cx_px=lens.cx_px + shift[0],
                cy_px=lens.cy_px + shift[1],
                kappa_per_px2=lens.kappa_per_px2 * shrink,
            ),
        )

    pair = StereoPair(resized(rig.pair.cam1), resized(rig.pair.cam2))
    return replace(rig, pair=pair, size_px=size_px)


def scene_at(rig: Rig, step: float) -> Scene:
    """The plane in a step; step 0 is the reference."""
    stretch = np.array([[1.0 + 2e-4 * step, 0.0], [0.0, 1.0 - 0.6e-4 * step]])
    motion = turn(np.array([0.2, 0.1, 1.0]), 2e-4 * step)
    motion = replace(motion, translation_mm=np.array([0.015, -0.010, 0.012]) * step)
    return plane_scene(rig.texture(1), in_plane=stretch, motion=motion)


def capture(rig: Rig, step: float) -> list[NDArray[np.uint8]]:
    """Both cameras' pictures of a step, 8 bit."""
    pictures = rig.capture(scene_at(rig, step), noise=NOISE, seed=int(100 * step))
    return [np.asarray(picture, dtype=np.uint8) for picture in pictures]


@dataclass(frozen=True)
class SequenceFiles:
    """A rendered sequence on disk: ``<folder>/cam1_0000.<suffix>`` and so on, and its calibration."""

    folder: Path
    steps: int
    suffix: str
    pair: StereoPair

    def arguments(self, roi: str, out: Path, *more: str) -> list[str]:
        """Arguments of ``stereorig measure``."""
        return [
            "measure",
            "--cam1",
            f"{self.folder}/cam1_*.{self.suffix}",
            "--cam2",
            f"{self.folder}/cam2_*.{self.suffix}",
            "--calibration",
            str(self.folder / "calibration.json"),
            "--roi",
            roi,
            "--out",
            str(out),
            *more,
        ]


def sequence_files(
    folder: Path, *, steps: int = 5, pictures: int = 5, suffix: str = "tif", size_px: tuple[int, int] = SEQUENCE_SIZE
) -> SequenceFiles:
    """Render a reference and ``steps`` pairs into ``folder``, or take what is there.

    Parameters
    ----------
    steps
        Pairs after the reference.
    pictures
        How many of them are rendered; further steps run back and forth through these files (hard links).
    suffix
        ``tif`` (uncompressed) or ``png``.
    """
    rig = rig_of_size(size_px)
    store = folder / f"{size_px[0]}x{size_px[1]}"
    store.mkdir(parents=True, exist_ok=True)
    for n in range(min(steps, pictures) + 1):
        names = [store / f"{cam}_{n:04d}.{suffix}" for cam in CAMERAS]
        if all(name.exists() for name in names):
            continue
        for name, picture in zip(names, capture(rig, n), strict=True):
            if suffix == "tif":
                name.write_bytes(encode_tiff(picture))
            else:
                Image.fromarray(picture).save(name)
    run = folder / f"{size_px[0]}x{size_px[1]}_{steps}_{suffix}"
    run.mkdir(exist_ok=True)
    round_trip = [*range(1, pictures + 1), *range(pictures - 1, 1, -1)]
    for n in range(steps + 1):
        source = 0 if n == 0 else round_trip[(n - 1) % len(round_trip)]
        for cam in CAMERAS:
            link = run / f"{cam}_{n:04d}.{suffix}"
            if not link.exists():
                os.link(store / f"{cam}_{source:04d}.{suffix}", link)
    calibration = {
        cam: camera.paper_parameters() for cam, camera in zip(CAMERAS, (rig.pair.cam1, rig.pair.cam2), strict=True)
    }
    (run / "calibration.json").write_text(json.dumps(calibration | _covariances(rig)))
    return SequenceFiles(run, steps, suffix, rig.pair)


def _covariances(rig: Rig) -> dict[str, Any]:
    """What a calibration with stages is expected to know of the cameras, by cause: results have a common factor by it."""
    pitch_mm = 3.0 * min(rig.size_px) / min(SEQUENCE_SIZE)  # it fills the same share of a smaller image
    target = GridTarget(pitch_mm=pitch_mm, lines=(11, 11), line_width_mm=0.05 * pitch_mm, node_tolerance_mm=0.002)
    one, two = (
        NominalValues(
            rig.size_px,
            phd_px=float(camera.paper_parameters()["phd_px"]),
            standoff_mm=float(camera.paper_parameters()["z0_mm"]),
            angle_deg=angle,
        )
        for camera, angle in ((rig.pair.cam1, -12.5), (rig.pair.cam2, 12.5))
    )
    expected = expect([-10.0, 0.0, 5.0, 10.0], target, (one, two), CalibrationOptions(lens="paper"))
    return {
        "covariance": {"names": list(expected.parameters), "matrix": expected.covariance.tolist()},
        "covariance_by_cause": {cause: part.tolist() for cause, part in expected.by_cause.items()},
    }
