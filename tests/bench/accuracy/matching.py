"""Plane, translation, strain, rotation and epipolar figures on the paper's rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, measure_motion, measure_shape
from stereorig.sim.scene import Scene
from tests.bench.accuracy.paper_rig import Rig, load_rig, plane_scene, true_points, turn
from tests.bench.accuracy.table import Row, Section

REGION = (90, 90, 420, 390)
TEXTURES = (1, 2, 3)


def _grid(step: int = 10) -> PointGrid:
    return PointGrid.rectangle(*REGION, spacing_px=step)


def _xy(field: Field) -> Float:
    return np.stack([field.x_px, field.y_px], axis=-1)


def _errors(rig: Rig, before: Scene, after: Scene, field: Field) -> tuple[Float, Float, Float]:
    """Errors of displacement (n, 3), of the position along Z_sys (n,), and (r, c, 3) displacement errors with holes, um."""
    assert field.uvw_mm is not None
    xyz, uvw = true_points(before, after, rig.pair.cam1, _xy(field))
    error = (field.uvw_mm - uvw) * 1e3
    dz = (field.xyz_mm - xyz)[..., 2] * 1e3
    return error[field.valid], dz[field.valid], error


def _motion(
    rig: Rig,
    before: Scene,
    after: Scene,
    *,
    noise: float,
    seed: int,
    subset: int,
    patch: str = "affine",
    interpolation: str = "quintic",
    pair: StereoPair | None = None,
) -> Field:
    ref = rig.capture(before, noise=noise, seed=seed)
    cur = rig.capture(after, noise=noise, seed=seed + 1000)
    options = MeasureOptions(subset_px=subset, patch=patch, interpolation=interpolation)  # type: ignore[arg-type]
    return measure_motion(pair or rig.pair, *ref, *cur, _grid(), options)


def plane(figures: Path) -> Section:
    """Z of a flat plate."""
    rig = load_rig()
    rows, samples = [], {}
    for subset, limit in ((21, 0.21), (33, 0.13)):
        errors, sigmas, lost = [], [], 0
        for seed in TEXTURES:
            scene = plane_scene(rig.texture(seed))
            field = measure_shape(rig.pair, *rig.capture(scene, seed=seed), _grid(), MeasureOptions(subset_px=subset))
            xyz, _ = true_points(scene, scene, rig.pair.cam1, _xy(field))
            # along Z_sys at the measured position: the plane is Z = 0, so Z itself
            errors.append(((field.xyz_mm - xyz)[..., 2] * 1e3)[field.valid])
            sigmas.append(field.sigma_mm[..., 2][field.valid] * 1e3)
            lost += int((~field.valid).sum())
        e, s = np.concatenate(errors), np.concatenate(sigmas)
        samples[subset] = e
        rows += [
            Row(f"plane, Z rms, {subset} px", float(np.sqrt(np.mean(e**2))), "um", limit),
            Row(f"plane, Z mean, {subset} px", abs(float(e.mean())), "um", 0.03),
            Row(f"reported over empirical sd, {subset} px", float(np.sqrt(np.mean(s**2)) / e.std()), ""),
            Row(f"points lost, {subset} px", lost, "", 0),
        ]
    fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for subset, e in samples.items():
        ax.hist(e, bins=60, histtype="step", density=True, label=f"{subset} px")
    ax.set(xlabel="error of Z / um", ylabel="density", title="Flat plate, noise 2 of 255")
    ax.legend()
    fig.savefig(figures / "accuracy_plane.png", dpi=110)
    plt.close(fig)
    return Section(
        "Plane",
        f"{len(TEXTURES)} speckle patterns, {samples[21].size} points, step 10 px; the true calibration.",
        rows,
        [("accuracy_plane.png", "Errors of Z on a plane")],
        [],
    )


def translation(figures: Path) -> Section:
    """Rigid translation in all three directions."""
    rig = load_rig()
    errors, sigmas = [], []
    means = []
    for seed in TEXTURES:
        for k in range(3):
            shift = np.array([0.013, -0.0071, 0.021]) * (1 + k) + np.array([0.0, 0.1, -0.05]) * k
            before = plane_scene(rig.texture(seed))
            after = plane_scene(rig.texture(seed), motion=RigidTransform(np.eye(3), shift))
            field = _motion(rig, before, after, noise=2.0, seed=10 * seed + k, subset=21)
            e, _, _ = _errors(rig, before, after, field)
            errors.append(e)
            means.append(e.mean(0))
            sigmas.append(field.sigma_mm[field.valid][:, 3:] * 1e3)
    e, s = np.concatenate(errors), np.concatenate(sigmas)
    spread = np.sqrt(np.mean([x.var(0) for x in errors], axis=0))
    rows = [
        Row("translation, 21 px: u random", float(spread[0]), "um", 0.19),
        Row("translation, 21 px: v random", float(spread[1]), "um", 0.19),
        Row("translation, 21 px: w random", float(spread[2]), "um", 0.29),
        Row("translation, 21 px: mean w, worst of the fields", float(np.abs(means)[:, 2].max()), "um", 0.06),
        Row("translation, 21 px: mean u, worst of the fields", float(np.abs(means)[:, 0].max()), "um"),
        Row("translation, 21 px: mean v, worst of the fields", float(np.abs(means)[:, 1].max()), "um"),
    ]
    ratio = np.sqrt((s**2).mean(0)) / spread
    rows += [Row(f"reported over empirical sd, {n}", float(r), "") for n, r in zip("uvw", ratio, strict=True)]
    fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for i, name in enumerate("uvw"):
        ax.hist(e[:, i], bins=60, histtype="step", density=True, label=name)
    ax.set(xlabel="error / um", ylabel="density", title="Translation, 21 px, noise 2 of 255")
    ax.legend()
    fig.savefig(figures / "accuracy_translation.png", dpi=110)
    plt.close(fig)
    return Section(
        "Translation",
        f"Three speckle patterns, three translations up to 0.2 mm, {len(e)} points.",
        rows,
        [("accuracy_translation.png", "Errors of u, v, w")],
        [],
    )


def strain(figures: Path) -> Section:
    """Five per cent of strain, noise-free: what the patch's model leaves."""
    rig = load_rig()
    rows, curves = [], {}
    strains = (0.01, 0.02, 0.05)
    for patch in ("affine", "rigid"):
        curve = []
        for eps in strains:
            before = plane_scene(rig.texture(1))
            after = plane_scene(rig.texture(1), in_plane=np.diag([1 - 0.33 * eps, 1 + eps]))
            field = _motion(rig, before, after, noise=0.0, seed=0, subset=21, patch=patch)
            e, _, _ = _errors(rig, before, after, field)
            curve.append(np.sqrt((e**2).mean(0)) if len(e) else np.full(3, np.nan))
            if eps == strains[-1]:
                rows.append(
                    Row(
                        f"{patch} patch, 5 % strain, noise-free, rms of the worst component",
                        float(curve[-1].max()),
                        "um",
                        0.04 if patch == "affine" else None,
                    )
                )
                rows.append(Row(f"{patch} patch, 5 % strain, points valid", 100 * float(field.valid.mean()), "%"))
            elif patch == "rigid":
                rows.append(
                    Row(
                        f"rigid patch, {100 * eps:g} % strain, rms of the worst component", float(curve[-1].max()), "um"
                    )
                )
        curves[patch] = np.array(curve)
    fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for patch, style in (("affine", "o-"), ("rigid", "s--")):
        for i, name in enumerate("uvw"):
            ax.semilogy(100 * np.array(strains), curves[patch][:, i], style, color=f"C{i}", label=f"{patch}, {name}")
    ax.set(xlabel="strain / %", ylabel="rms error / um", title="Strained plane, 21 px, noise-free")
    ax.legend(ncols=2, fontsize=8)
    fig.savefig(figures / "accuracy_strain.png", dpi=110)
    plt.close(fig)
    return Section(
        "Strain",
        "Uniaxial strain with Poisson's ratio 0.33, 21 px, noise-free; all errors, systematic and random, together.",
        rows,
        [("accuracy_strain.png", "Errors under strain")],
        ["The rigid patch is the paper's: under strain e its edge is off by e h / 2, and that goes into u, v and w."],
    )


def rotation(figures: Path) -> Section:
    """Rotations in the plane and out of it, noise-free."""
    rig = load_rig()
    angles = (2.0, 5.0, 10.0, 15.0, 20.0, 25.0)
    axes = {"in plane (about Z)": np.array([0.0, 0.0, 1.0]), "tilt (about the vertical)": np.array([1.0, 1.0, 0.0])}
    curves: dict[str, list[float]] = {}
    worst: dict[str, float] = {}
    for label, axis in axes.items():
        curves[label] = []
        for angle in angles:
            before = plane_scene(rig.texture(1))
            after = plane_scene(rig.texture(1), motion=turn(axis, np.radians(angle)))
            field = _motion(rig, before, after, noise=0.0, seed=0, subset=21)
            e, _, _ = _errors(rig, before, after, field)
            curves[label].append(float(np.sqrt((e**2).mean(0)).max()) if len(e) else np.nan)
        worst[label] = max(curves[label])
    rows = [
        Row(
            f"rotation up to 25 degrees {k}, noise-free, rms of the worst component",
            v,
            "um",
            0.1 if "plane" in k else None,
        )
        for k, v in worst.items()
    ]
    fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for label, curve in curves.items():
        ax.plot(angles, curve, "o-", label=label)
    ax.set(xlabel="rotation / degrees", ylabel="rms error / um", title="Turned plane, 21 px, noise-free")
    ax.legend()
    fig.savefig(figures / "accuracy_rotation.png", dpi=110)
    plt.close(fig)
    return Section(
        "Rotation",
        "Rigid rotation about the origin, 21 px, noise-free; points that leave a view are lost.",
        rows,
        [("accuracy_rotation.png", "Errors under rotation")],
        [
            "The limit is put to the rotation in the plane. A tilt of 25 degrees turns the plate 55 degrees away from one camera, whose "
            "pixels then see speckle compressed to two thirds: its error is scatter, not a mean, and is above 0.1 um from about 15 degrees "
            "at 21 px."
        ],
    )


def epipolar(figures: Path) -> Section:
    """Camera 2's cy wrong by 0.1 px."""
    del figures
    rig = load_rig()
    lens2 = rig.pair.cam2.lens
    assert isinstance(lens2, SeidelLens)
    wrong = StereoPair(rig.pair.cam1, Camera(replace(lens2, cy_px=lens2.cy_px + 0.1), rig.pair.cam2.cam_from_sys))
    before = plane_scene(rig.texture(1))
    after = plane_scene(rig.texture(1), motion=RigidTransform(np.eye(3), np.array([0.05, 0.03, -0.04])))
    field = _motion(rig, before, after, noise=2.0, seed=5, subset=21, pair=wrong)
    e, _, _ = _errors(rig, before, after, field)
    right = _motion(rig, before, after, noise=2.0, seed=5, subset=21)
    e0, _, _ = _errors(rig, before, after, right)
    mean = float(np.abs((e - 0).mean(0)).max())
    xy1 = _xy(field)[field.valid]
    xyz, _ = true_points(before, after, rig.pair.cam1, xy1)
    expected = np.abs(wrong.epipolar_residual_px(xy1, rig.pair.cam2.project(xyz).xy)).mean()
    offset = float(np.abs(np.nanmean(field.epipolar_px)))
    rows = [
        Row("camera 2's cy wrong by 0.1 px: mean false displacement, worst component", mean, "um", 0.15),
        Row("the same with the true calibration", float(np.abs(e0.mean(0)).max()), "um"),
        Row("reported epipolar offset", offset, "px"),
        Row("its departure from 0.1 px", 100 * abs(offset / 0.1 - 1), "%", 5.0),
        Row("true offset across the epipolar lines", float(expected), "px"),
    ]
    return Section(
        "A wrong calibration",
        "A rigid translation of 0.07 mm, 21 px, noise 2; the offset is each point's thirteenth unknown.",
        rows,
        [],
        [],
    )
