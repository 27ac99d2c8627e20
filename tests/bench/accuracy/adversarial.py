"""Pictures that invite wrong matches: how many wrong points pass, and how many right ones are lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stereorig.core.arrays import Float
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import StereorigError
from stereorig.core.field.checks.epipolar_offset import check_epipolar
from stereorig.core.field.checks.validity import ValidityOptions
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair, measure_motion
from stereorig.core.settings import SINGLE_MAX_SIGMA_PX
from stereorig.sim.scene import Scene
from stereorig.sim.texture import dots
from tests.bench.accuracy.adversarial_scenes import Case, Pictures
from tests.bench.accuracy.paper_rig import Rig, plane_scene, true_points, turn
from tests.bench.accuracy.table import Row, Section
from tests.bench.speed.scene import rig_of_size

Mask = NDArray[np.bool_]
SIGMAS = 6.0
KEPT_PERCENT = 99.0
SPLINE_PX = 3  # reach of the interpolation beyond a subset's pixels

CASES: dict[str, Callable[[Pictures], Case]] = {
    "thing in front of both cameras": Pictures.occluder,
    "thing in front of camera 1": Pictures.occluder_one,
    "paint without speckle": Pictures.blank,
    "moving highlights": Pictures.highlight,
    "flakes": Pictures.flakes,
    "blur, sd 1 px": lambda p: p.blur(1.0, matchable=True),
    "blur, sd 2 px": lambda p: p.blur(2.0, matchable=True),
    "blur, sd 3 px": lambda p: p.blur(3.0, matchable=False),
    "smeared by 15 px": lambda p: p.motion_blur(15),
    "5 % in patches": lambda p: p.patches(0.05),
    "20 % in patches": lambda p: p.patches(0.2),
    "20 % in camera 2": lambda p: p.patches_one(0.2),
    "50 % in patches": lambda p: p.patches(0.5),
    "30 % shines through": lambda p: p.shines_through(0.3),
    "noise 20": lambda p: p.noise(20.0),
    "over-exposed 1.5 times": lambda p: p.overexposed(1.5),
}


@dataclass(frozen=True)
class _Setting:
    """How one of the rigs is used."""

    name: str
    rig: str
    size_px: tuple[int, int]
    region: tuple[float, float, float, float]
    spacing_px: float
    subset_px: int
    px_um: float


MODERN = _Setting("modern rig, 33 px", "sim_modern", (1200, 1100), (100, 100, 1100, 1000), 5, 33, 39.0)
PAPER = _Setting("paper's rig, 21 px", "sim_paper", (512, 480), (60, 60, 452, 420), 3, 21, 33.0)


@dataclass(frozen=True)
class _Scene:
    """The surface before and after, its pictures, and the truth at the points."""

    setting: _Setting
    rig: Rig
    still: Scene
    moved: Scene
    grid: PointGrid
    pictures: Pictures
    here: Float
    motion: Float


@dataclass(frozen=True)
class _Outcome:
    """One case: the field or the refusal's code, and which points count as what."""

    field: Field | None
    code: str
    error_um: Float
    wrong: Mask
    clean: Mask

    @property
    def valid(self) -> int:
        return 0 if self.field is None else int(self.field.valid.sum())


def _scene(setting: _Setting) -> _Scene:
    rig = rig_of_size(setting.size_px, name=setting.rig)
    tilt = replace(turn(np.array([0.2, 0.1, 1.0]), np.deg2rad(0.4)), translation_mm=np.array([0.08, -0.05, 0.06]))
    still = plane_scene(rig.texture(1))
    moved = plane_scene(rig.texture(1), in_plane=np.diag([1.004, 0.9985]), motion=tilt)
    other = plane_scene(rig.texture(7), motion=turn(np.array([0.0, 0.0, 1.0]), np.deg2rad(0.3)))
    clean = (*rig.capture(still, seed=1), *rig.capture(moved, seed=2))
    grid = PointGrid.rectangle(*setting.region, spacing_px=setting.spacing_px)
    here, motion = true_points(still, moved, rig.pair.cam1, grid.xy_px)
    pictures = Pictures(clean, tuple(rig.capture(other, seed=3)))  # type: ignore[arg-type]
    return _Scene(setting, rig, still, moved, grid, pictures, here, motion)


def _touched(mask: Mask, xy_px: Float, subset_px: int) -> Mask:
    """Mask of subsets about positions (r, c, 2) that reach a spoiled pixel."""
    if not mask.any():
        return np.zeros(xy_px.shape[:2], bool)
    reach = subset_px // 2 + SPLINE_PX + 1
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    at = np.rint(xy_px).astype(int)
    rows, cols = mask.shape
    return np.asarray(grown[np.clip(at[..., 1], 0, rows - 1), np.clip(at[..., 0], 0, cols - 1)] > 0)


def _run(scene: _Scene, case: Case) -> _Outcome:
    pair = scene.rig.pair
    cameras = (pair.cam1, pair.cam2, pair.cam1, pair.cam2)
    positions = [c.project(scene.here + (scene.motion if k > 1 else 0.0)).xy for k, c in enumerate(cameras)]
    clean = np.full(scene.grid.shape, case.matchable)
    for mask, xy in zip(case.spoiled, positions, strict=True):
        clean &= ~_touched(mask, xy, scene.setting.subset_px)
    nothing = np.full(scene.grid.shape, np.nan)
    try:
        field = measure_motion(pair, *case.pictures, scene.grid, MeasureOptions(subset_px=scene.setting.subset_px))
    except StereorigError as error:
        return _Outcome(None, error.code, nothing, np.zeros(scene.grid.shape, bool), clean)
    assert field.uvw_mm is not None
    error = field.uvw_mm - scene.motion
    size = 1e3 * np.linalg.norm(error, axis=-1)
    with np.errstate(invalid="ignore"):
        beyond = (np.abs(error) > SIGMAS * field.sigma_mm[..., 3:]).any(axis=-1)
        wrong = field.valid & ((size > 0.5 * scene.setting.px_um) | beyond)
    return _Outcome(field, "", size, wrong, clean)


def adversarial(figures: Path) -> Section:
    """Measure every case from its four pictures alone, on two rigs."""
    rows: list[Row] = []
    notes: list[str] = []
    valid = wrong = clean = kept = 0
    for setting in (MODERN, PAPER):
        scene = _scene(setting)
        shown = []
        for name, make in CASES.items():
            case = make(scene.pictures)
            outcome = _run(scene, case)
            here, bad = outcome.valid, int(outcome.wrong.sum())
            rows.append(Row(f"{setting.name}, {name}: wrong among the valid", float(bad), f"of {here}"))
            if outcome.clean.any():
                right = 0 if outcome.field is None else int((outcome.field.valid & outcome.clean).sum())
                share = 100.0 * right / int(outcome.clean.sum())
                sigma_px = _sigma_px(scene, case) if share < KEPT_PERCENT else 0.0
                allowed = sigma_px < SINGLE_MAX_SIGMA_PX
                what = "the same: valid where every image shows the subset"
                rows.append(Row(what, share, "%", KEPT_PERCENT if allowed else None, at_least=True))
                if sigma_px > 0.0:
                    rows.append(Row("the same: scatter of matches without the limit on it, rms", sigma_px, "px"))
                if allowed:
                    clean, kept = clean + int(outcome.clean.sum()), kept + right
            if outcome.field is None:
                notes.append(f"{setting.name}, {name}: refused as a whole, `{outcome.code}`.")
            valid, wrong = valid + here, wrong + bad
            shown.append((name, case.pictures[2], outcome))
        if setting is MODERN:
            _draw(figures / "accuracy_adversarial.png", scene, shown)
            other = [*_calibrations(scene)], [*_refusals(scene)]
    rows += [
        Row("all: valid points", float(valid), ""),
        Row("all: wrong points per 100,000 valid ones", 1e5 * wrong / valid, "", 1.0),
        Row("all: valid where they are to be kept", 100.0 * kept / clean, "%", KEPT_PERCENT, at_least=True),
        *other[0],
    ]
    return Section(
        "Pictures that invite wrong matches",
        "A speckled plane that turns by 0.4 degrees, stretches by 0.4 % and moves by some 3 px, noise 2, on the modern rig (1200 x 1100 px, 36,381 points) and the "
        "paper's (15,851 points). The pair at t, in some cases the reference too, is spoiled as named. A point is wrong if its "
        f"displacement is off by more than half a pixel's width on the surface or by more than {SIGMAS:g} of its own reported standard deviations. What is to be kept: points whose "
        "subset every image shows, unless matches there scatter by more than a tenth of a pixel, so that half a pixel is within five standard deviations.",
        rows,
        [
            (
                "accuracy_adversarial.png",
                "Modern rig, camera 1 at t; valid points coloured by their error, refused ones left out",
            )
        ],
        notes + other[1],
    )


def _sigma_px(scene: _Scene, case: Case) -> float:
    """How far matches are off in camera 1, rms, if none is refused for its scatter: what the pictures allow."""
    free = ValidityOptions(max_sigma_px=10.0)
    options = MeasureOptions(subset_px=scene.setting.subset_px, validity=free)
    field = measure_motion(scene.rig.pair, *case.pictures, scene.grid, options)
    assert field.uvw_mm is not None
    camera = scene.rig.pair.cam1
    found, true = (camera.project(scene.here + motion).xy for motion in (field.uvw_mm, scene.motion))
    return float(np.sqrt(np.nanmean((found - true) ** 2)))


def _calibrations(scene: _Scene) -> list[Row]:
    """Calibrations of camera 2 that are wrong by a pixel."""
    pair = scene.rig.pair
    lens = pair.cam2.lens
    assert isinstance(lens, SeidelLens)
    grid = PointGrid.rectangle(*scene.setting.region, spacing_px=4 * scene.setting.spacing_px)
    here, motion = true_points(scene.still, scene.moved, pair.cam1, grid.xy_px)
    wrong = {
        "across the epipolar lines": replace(pair.cam2, lens=replace(lens, cy_px=lens.cy_px + 1.0)),
        "along the epipolar lines": replace(pair.cam2, lens=replace(lens, cx_px=lens.cx_px + 1.0)),
        "in its roll, at the corners": replace(
            pair.cam2,
            cam_from_sys=turn(np.array([0.0, 0.0, 1.0]), 2.0 / np.hypot(*scene.setting.size_px))
            @ pair.cam2.cam_from_sys,
        ),
    }
    rows = []
    for name, camera in wrong.items():
        field = ReferencePair(StereoPair(pair.cam1, camera), *scene.pictures.clean[:2]).motion(
            *scene.pictures.clean[2:], grid, MeasureOptions(subset_px=scene.setting.subset_px)
        )
        assert field.uvw_mm is not None
        check = check_epipolar(field, 0.02)
        assert check is not None
        error = 1e3 * np.linalg.norm(field.uvw_mm - motion, axis=-1)
        rows += [
            Row(f"calibration off by 1 px {name}: largest error of a displacement", float(np.nanmax(error)), "um"),
            Row("the same: mean error of Z", 1e3 * float(np.nanmean(np.abs(field.xyz_mm - here)[..., 2])), "um"),
            Row(f"the same: offset by the epipolar check, {check.level}", check.offset_px, "px"),
        ]
    return rows


def _refusals(scene: _Scene) -> list[str]:
    """Cases that are refused before any point is measured."""
    clean = scene.pictures.clean
    lattice = plane_scene(dots(pitch_mm=0.6, diameter_mm=0.3, rim_mm=0.03))
    repeated = scene.rig.capture(lattice, seed=1)
    blank = np.full_like(clean[0], 128)
    tries = {
        "cameras exchanged at the reference": (clean[1], clean[0], *clean[2:]),
        "cameras exchanged at t": (*clean[:2], clean[3], clean[2]),
        "camera 2 blank at t": (*clean[:3], blank),
        "camera 2 still shows the reference at t": (*clean[:3], clean[1]),
        "texture that repeats itself (dots on a lattice)": (*repeated, *repeated),
    }
    out = []
    for name, pictures in tries.items():
        try:
            field = measure_motion(
                scene.rig.pair, *pictures, scene.grid, MeasureOptions(subset_px=scene.setting.subset_px)
            )
            out.append(f"{name}: **not refused**, {int(field.valid.sum())} points valid.")
        except StereorigError as error:
            out.append(f"{name}: refused, `{error.code}`.")
    return out


def _draw(path: Path, scene: _Scene, shown: list[tuple[str, NDArray[np.uint8], _Outcome]]) -> None:
    figure, axes = plt.subplots(4, 4, figsize=(11, 10.4), layout="constrained")
    colours = None
    there = scene.rig.pair.cam1.project(scene.here + scene.motion).xy
    for axis, (name, picture, outcome) in zip(axes.flat, shown, strict=True):
        axis.imshow(picture, cmap="gray", vmin=-120, vmax=330)
        error = np.where(np.isfinite(outcome.error_um), outcome.error_um, np.nan)
        colours = axis.scatter(
            there[..., 0], there[..., 1], c=error, s=0.6, vmin=0.0, vmax=5.0, cmap="turbo", linewidths=0
        )
        if outcome.wrong.any():
            axis.plot(*there[outcome.wrong].T, "rx", ms=6)
        axis.set(xticks=[], yticks=[])
        axis.set_title(f"{name}\n{outcome.valid} valid", fontsize=8)
    assert colours is not None
    figure.colorbar(colours, ax=axes, label="error of u, v, w together, um", shrink=0.5)
    figure.savefig(path, dpi=60)
    plt.close(figure)
    with Image.open(path) as drawn:  # sixteen photographs: a tenth of the size with a palette
        drawn.convert("RGB").quantize(192).save(path, optimize=True)
