"""A replicate through the command line: its pictures and files written, calibrated, measured, its gauges read."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from stereorig.server.cli.main import main
from tests.bench.coverage.draw import (
    CORNERS,
    FOCAL_PX,
    GAMMA_DEG,
    LINES,
    PITCH_MM,
    SIZE,
    SQUARE_MM,
    STANDOFF_MM,
    WIDTH_MM,
    Replicate,
)
from tests.bench.coverage.render import Light, exposed, speckled
from tests.bench.coverage.strata import Stratum
from tests.bench.coverage.targets import drawn_target

ROI = (55, 55, 167, 167)
SPACING_PX = 14
ENDS = (55, 55, 167, 167)  # an extensometer of some 10 mm, its ends at points of the grid
INSIDE = (83, 83, 139, 139)
LIGHT = Light()


@dataclass(frozen=True)
class Run:
    """What the command line left of a replicate.

    Attributes
    ----------
    folder
        With ``calibration.json`` and ``results``.
    verdict, reasons
        Of the calibration.
    gauges, moved
        The documents of ``stereorig gauge``: an extensometer and an area; the rigid motions.
    said
        What was printed.
    """

    folder: Path
    verdict: str
    reasons: tuple[str, ...]
    gauges: dict[str, Any]
    moved: dict[str, Any]
    said: str


class ChainError(Exception):
    """A command of the chain ended with an error."""


def command(*words: str | Path) -> str:
    """Run a command of the command line in this process; return what it prints.

    Raises
    ------
    ChainError
        It did not end with 0.
    """
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        status = main([str(word) for word in words])
    if status != 0:
        raise ChainError(f"{words[0]} ended with {status}: {out.getvalue()[-600:]}")
    return out.getvalue()


def run(replicate: Replicate, folder: Path) -> Run:
    """Write a replicate's files and run calibrate, noise, measure and gauge on them."""
    s, rng = replicate.stratum, replicate.rng
    views, images = folder / "views", folder / "images"
    for made in (views, images):
        made.mkdir(parents=True, exist_ok=True)
    for view in replicate.views:
        grey = drawn_target(view.camera, replicate.made, LIGHT)
        _write(views / view.file, exposed(grey, s.view_noise, rng, correlated_px=s.view_noise_px))
    _describe(folder, s)
    said = command(
        *("calibrate", views, "--target", folder / "target.toml", "--rig", folder / "rig.toml"),
        *("--out", folder / "calibration.json"),
    )
    steps = [(np.eye(3), np.zeros(3)), *((A, b) for _, A, b in replicate.motions)]
    noise = (s.noise, s.noise if s.noise_2 is None else s.noise_2)
    fixed = [_pattern(s, camera.size, rng) for camera in replicate.cameras]
    for k, (A, b) in enumerate(steps):
        light = Light(blur_px=LIGHT.blur_px + s.blur_in_time * (k > 0))
        for c, camera in enumerate(replicate.cameras):
            grey = speckled(camera, replicate.sheet.moved(A, b, s.neck_mm if k else (0.0, 1.0)), light) + fixed[c]
            _write(images / f"cam{c + 1}_{k:04d}.tif", exposed(grey, noise[c], rng, correlated_px=s.noise_px))
            if k == 0 and s.declare_white:
                for n in range(6):
                    frame = exposed(grey, noise[c], rng, correlated_px=s.noise_px)
                    _write(folder / f"frame_cam{c + 1}_{n}.tif", frame)
    more: list[str | Path] = []
    if s.declare_white:
        frames = [w for c in (1, 2) for w in (f"--cam{c}", folder / f"frame_cam{c}_*.tif")]
        said += command("noise", *frames, "-o", folder / "noise.json")
        more = ["--noise", folder / "noise.json"]
    said += command(
        *("measure", "--cam1", images / "cam1_*.tif", "--cam2", images / "cam2_*.tif"),
        *("--calibration", folder / "calibration.json", "--out", folder / "results"),
        *("--roi", _list(ROI), "--subset", str(s.subset_px), "--step", str(SPACING_PX), "--strain", "5"),
        *(*s.options, *more),
    )
    results = folder / "results"
    said += command(
        "gauge", results, "--extensometer", _list(ENDS), "--area", _list(INSIDE), "--out", folder / "gauges.json"
    )
    rigid = [k + 1 for k, (name, _, _) in enumerate(replicate.motions) if name.startswith(("rotation", "w"))]
    chosen = [w for k in rigid or [1] for w in ("--step", str(k))]
    said += command(
        "gauge", results, "--remove-rigid", "--point", _list(ENDS[:2]), *chosen, "--out", folder / "rigid.json"
    )
    verdict = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))["verdict"]
    return Run(
        folder,
        verdict["level"],
        tuple(verdict["reasons"]),
        json.loads((folder / "gauges.json").read_text(encoding="utf-8")),
        json.loads((folder / "rigid.json").read_text(encoding="utf-8")),
        said,
    )


def _pattern(s: Stratum, size: tuple[int, int], rng: np.random.Generator) -> Any:
    """What a sensor adds to each image; nothing is drawn where there is none."""
    if not (s.columns or s.pixels):
        return 0.0
    width, height = size
    return s.columns * rng.standard_normal(width)[None] + s.pixels * rng.standard_normal((height, width))


def _list(numbers: Sequence[int]) -> str:
    return ",".join(map(str, numbers))


def _write(path: Path, picture: Any) -> None:
    tifffile.imwrite(path, picture)


def _describe(folder: Path, s: Stratum) -> None:
    """Write target and rig as the laboratory declares them."""
    if s.free:
        shape = (
            f'kind = "checkerboard"\nsize = [{CORNERS[0]}, {CORNERS[1]}]\npitch_mm = {SQUARE_MM}\nflatness_mm = 0.0\n'
        )
    else:
        shape = (
            f'kind = "line_grid"\nlines = [{LINES[0]}, {LINES[1]}]\npitch_mm = {PITCH_MM}\nline_width_mm = {WIDTH_MM}\n'
        )
    shape += f"node_tolerance_mm = {s.tolerance_mm}\npitch_scale_sigma = {s.pitch}\n"
    (folder / "target.toml").write_text(shape, encoding="utf-8")
    rig = []
    for c, sign in enumerate((-1.0, 1.0)):
        rig += [f"[cam{c + 1}]", f"image_size_px = [{SIZE[0]}, {SIZE[1]}]", f"phd_px = {s.reach * FOCAL_PX}"]
        rig += [f"standoff_mm = {s.reach * STANDOFF_MM}", f"angle_deg = {sign * GAMMA_DEG}", "aspect = 1.0"]
    rig += ["[calibration]", f'lens = "{s.lens_model}"', f'moves = "{"free" if s.free else "cameras"}"']
    rig += [f"stage_scale_sigma = {s.scale}", f"stage_step_sigma_mm = {s.step_mm}"]
    if s.declared_tilt_rad is not None:
        rig.append(f"axis_tilt_sigma_rad = {s.declared_tilt_rad}")
    (folder / "rig.toml").write_text("\n".join(rig) + "\n", encoding="utf-8")
