"""Make the sample of the page's Try it: a notched sheet in tension, three loads, and a calibration of its cameras.

``python -m tests.bench.documents.sample`` writes ``server/static/sample``. The images are rendered from the formula of
`stereorig.sim.notch` after a small rigid motion of the sheet; the calibration is what ``stereorig calibrate`` makes of
rendered views of a line grid.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.cli.main import main as command
from stereorig.sim.notch import NotchedSheet
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import flat
from stereorig.sim.texture import line_grid, speckle
from tests.bench.accuracy.paper_rig import Rig, turn
from tests.bench.speed.scene import rig_of_size
from tests.support.requirements import ROOT

FOLDER = ROOT / "server" / "static" / "sample"
SIZE_PX = (640, 512)
SECTION_MM2 = 100.0
LOADS_KN = (0.0, 4.0, 7.0, 10.0)
SHEET = NotchedSheet()
REGION_PX = [62, 30, 609, 481]
SETTINGS = {"subset_px": 21, "spacing_px": 5, "strain": {"window": 7}}
NOISE = 1.5  # grey levels
_SPECKLE_MM = 0.17
_PITCH_MM, _LINE_MM, _NODE_MM = 1.7, 0.1, 0.001
_POSITIONS_MM = (-8.0, -4.0, 0.0, 4.0, 8.0)
_TARGET = f"""kind = "line_grid"
pitch_mm = {_PITCH_MM}
lines = [11, 11]
line_width_mm = {_LINE_MM}
node_tolerance_mm = {_NODE_MM}
"""
_CAMERA = """[cam{k}]
image_size_px = [{size[0]}, {size[1]}]
phd_px = 10145.0
standoff_mm = 400.0
angle_deg = {angle}
aspect = 1.0
"""


@cache
def sample_rig() -> Rig:
    """Return the true cameras: the modern rig's, on smaller sensors, with the system frame upright in their images."""
    rig = rig_of_size(SIZE_PX)
    cameras = [Camera(one.lens, one.cam_from_sys @ UPRIGHT) for one in (rig.pair.cam1, rig.pair.cam2)]
    return replace(rig, pair=StereoPair(*cameras))


def scene_at(load_kn: float) -> Scene:
    """Return the sheet under a load; its grips give way, so that it moves and turns a little as a whole."""
    share = load_kn / LOADS_KN[-1]
    moved = turn(np.array([0.3, 1.0, 0.2]), 5e-4 * share)
    motion = RigidTransform(moved.rotation, moved.translation_mm + share * np.array([0.06, 0.11, 0.03]))
    surface = SHEET.surface(1e3 * load_kn / SECTION_MM2)
    texture = speckle(diameter_mm=_SPECKLE_MM, seed=7)
    return Scene(name="notch", surface=surface, texture=texture, sys_from_body=motion)


def pair_at(step: int) -> list[NDArray[np.uint8]]:
    """Return both cameras' images of a step, 8 bit."""
    images = sample_rig().capture(scene_at(LOADS_KN[step]), noise=NOISE, seed=100 + step)
    return [np.asarray(image, np.uint8) for image in images]


def notch_px() -> Float:
    """Return the notch's edge in camera 1's reference image, (48, 2) px."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    edge = np.stack([SHEET.half_length_mm * np.cos(angle), SHEET.half_width_mm * np.sin(angle), 0.0 * angle], axis=1)
    return sample_rig().pair.cam1.project(edge).xy


def _calibrate(out: Path) -> None:
    rig = sample_rig()
    texture = line_grid(pitch_mm=_PITCH_MM, lines=(11, 11), line_width_mm=_LINE_MM, node_tolerance_mm=_NODE_MM, seed=3)
    with tempfile.TemporaryDirectory() as work:
        views = Path(work) / "views"
        views.mkdir()
        for n, dz_mm in enumerate(_POSITIONS_MM):
            grid = Scene(name="grid", surface=flat(), texture=texture)
            for k, image in enumerate(rig.capture(grid, noise=NOISE, seed=n, dz_mm=dz_mm), start=1):
                Image.fromarray(np.asarray(image, np.uint8)).save(views / f"cam{k}_{dz_mm:+.3f}mm.tif")
        (Path(work) / "target.toml").write_text(_TARGET)
        cameras = [_CAMERA.format(k=k, size=SIZE_PX, angle=angle) for k, angle in ((1, -12.5), (2, 12.5))]
        (Path(work) / "rig.toml").write_text("".join(cameras))
        given = ["--target", f"{work}/target.toml", "--rig", f"{work}/rig.toml", "--out", str(out)]
        if command(["calibrate", str(views), *given]) != 0:
            raise RuntimeError("the sample's calibration failed")


def main() -> None:
    """Write the images, the calibration and their description."""
    FOLDER.mkdir(exist_ok=True)
    _calibrate(FOLDER / "calibration.json")
    for step in range(len(LOADS_KN)):
        for k, image in enumerate(pair_at(step), start=1):
            Image.fromarray(image).save(FOLDER / f"cam{k}_{step:04d}.png", optimize=True)
    (FOLDER / "sample.json").write_text(json.dumps(described()) + "\n")


def described() -> dict[str, Any]:
    """Return the test as the page makes it: its steps, and region, settings, gauges and display as a recipe."""
    edge = notch_px()
    right, low, high = edge[np.argmax(edge[:, 0])], edge[np.argmax(edge[:, 1])], edge[np.argmin(edge[:, 1])]
    line = {
        "name": "ligament",
        "vertices_px": [[round(float(right[0])) + 12, round(float(right[1]))], [600, round(float(right[1]))]],
    }
    across = {"name": "across", "a_px": [round(float(high[0])), round(float(high[1])) - 40]}
    across["b_px"] = [across["a_px"][0], round(float(low[1])) + 40]
    return {
        "name": "Sample: notched sheet in tension",
        "specimen": "7075-T6 sheet of 100 mm2 with an elliptical notch of 8 x 5 mm, rendered",
        "notes": "Rendered from Inglis's solution: far from the notch 1,393 microstrain along y at 10 kN.",
        "steps": [
            {
                "cam1": f"cam1_{n:04d}.png",
                "cam2": f"cam2_{n:04d}.png",
                "label": f"{load_kn:g} kN" if n else "reference",
                "channels": {"load_kn": load_kn},
            }
            for n, load_kn in enumerate(LOADS_KN)
        ],
        "recipe": {
            "image_size_px": SIZE_PX,
            "region": {"rectangle": REGION_PX, "holes": [np.round(edge, 1).tolist()]},
            "settings": SETTINGS,
            "gauges": {"extensometers": [across], "lines": [line], "variables": ["eyy"]},
            "display": {"field": "eyy"},
        },
    }


if __name__ == "__main__":
    main()
