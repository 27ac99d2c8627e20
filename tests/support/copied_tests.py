"""Tests as another service would have left them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.images import encode_tiff
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.service_rig import TINY

TIME = "2026-01-01T00:00:00Z"


CONFIG = TINY.replace("speckle_mm = 0.45", "speckle_mm = 0.4").replace("kernel_threads = 1", "kernel_threads = 2")


def write_test_folder(folder: Path, steps: int, load_a_step: float = 0.0) -> None:
    """Write a test as another service would have left it: a copied folder is a valid test."""
    config = parse_config(CONFIG)
    rig = SimRig.from_dict(config.model_dump(exclude_none=True))
    world = SimWorld(rig, lambda _: 0.0)
    rng = np.random.default_rng(5)

    def images() -> Iterator[Sequence[np.ndarray]]:
        for n in range(steps):
            world.set_scene("plate", load=n * load_a_step)
            yield [world.expose(cam, exposure_ms=10.0, gain_db=0.0, rng=rng) for cam in CAMERAS]  # type: ignore[arg-type]

    write_test_of(folder, world.true_pair(), images())


def write_test_of(folder: Path, pair: StereoPair, images: Iterable[Sequence[np.ndarray]]) -> None:
    """Write a test of given pairs of images, calibrated with the cameras that took them."""
    (folder / "analyses").mkdir(parents=True)
    calibration = {"cam1": pair.cam1.paper_parameters(), "cam2": pair.cam2.paper_parameters()}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    for n, both in enumerate(images):
        step = folder / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        sha256 = {}
        for cam, image in zip(CAMERAS, both, strict=True):
            content = encode_tiff(image)
            (step / f"{cam}.tif").write_bytes(content)
            sha256[cam] = hashlib.sha256(content).hexdigest()
        metadata = {
            "label": "",
            "load_n": None,
            "source": "import",
            "captured_utc": TIME,
            "skew_ms": None,
            "quality": {},
        }
        document = {"n": n, "test_id": folder.name, **metadata, "sha256": sha256}
        (step / "step.json").write_text(json.dumps(document))
    document = {"id": folder.name, "name": "copied", "specimen": "", "notes": "", "calibration_id": None}
    (folder / "test.json").write_text(json.dumps({**document, "created_utc": TIME}))
