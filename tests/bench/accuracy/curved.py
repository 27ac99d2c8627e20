"""Curved patches: what they remove on curved surfaces and motions, what they cost on plane ones, what `auto` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.settings import PatchSetting
from stereorig.sim.catalog import make_scene
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import UPRIGHT, Scene
from stereorig.sim.surface import Surface, flat, sphere
from tests.bench.accuracy.paper_rig import ROOT, Rig, load_rig, plane_scene, true_points
from tests.bench.accuracy.table import Row, Section

REGION = (90, 90, 420, 390)
RADIUS_MM = 30.0
PATCHES: tuple[PatchSetting, ...] = ("affine", "quadratic", "auto")
NAMES = {"affine": "plane", "quadratic": "quadratic", "auto": "auto"}


@dataclass(frozen=True)
class Errors:
    """Errors of one field, um: of the position along Z_sys (r, c) and of the displacement (r, c, 3), NaN where empty."""

    field: Field
    z_um: Float
    uvw_um: Float | None

    @property
    def z(self) -> Float:
        return self.z_um[self.field.valid]

    @property
    def uvw(self) -> Float:
        assert self.uvw_um is not None
        return self.uvw_um[self.field.valid]

    @property
    def reason(self) -> str:
        assert self.field.patch is not None
        return self.field.patch.reason

    @property
    def chosen(self) -> str:
        assert self.field.patch is not None
        return self.field.patch.patch


def _rms(e: Float) -> float:
    """Root mean square of scalars, or of the lengths of vectors."""
    return float(np.sqrt(np.mean(e**2 if e.ndim == 1 else (e**2).sum(-1))))


def _grid(step: int = 10, region: tuple[float, float, float, float] = REGION) -> PointGrid:
    return PointGrid.rectangle(*region, spacing_px=step)


def _measure(
    rig: Rig,
    before: Scene,
    after: Scene | None,
    *,
    subset: int,
    noise: float,
    seed: int,
    patches: tuple[PatchSetting, ...] = PATCHES,
    grid: PointGrid | None = None,
) -> dict[PatchSetting, Errors]:
    """Measure the same pictures with each patch; a shape if there is no ``after``."""
    grid = _grid() if grid is None else grid
    reference = ReferencePair(rig.pair, *rig.capture(before, noise=noise, seed=seed))
    current = None if after is None else rig.capture(after, noise=noise, seed=seed + 1000)
    xyz, uvw = true_points(before, after or before, rig.pair.cam1, grid.xy_px)
    out = {}
    for patch in patches:
        options = MeasureOptions(subset_px=subset, patch=patch)
        field = reference.shape(grid, options)
        if current is not None:
            field = reference.motion(current[0], current[1], grid, options, shape=field)
        moved = None if field.uvw_mm is None else (field.uvw_mm - uvw) * 1e3
        out[patch] = Errors(field, ((field.xyz_mm - xyz)[..., 2]) * 1e3, moved)
    return out


def _scene(rig: Rig, surface: Surface, *, seed: int = 1, shift_mm: Float | None = None) -> Scene:
    pose = UPRIGHT if shift_mm is None else RigidTransform(np.eye(3), shift_mm) @ UPRIGHT
    return Scene(name="bent", surface=surface, texture=rig.texture(seed), sys_from_body=pose)


def sphere_shape(figures: Path) -> Section:
    """Shape of a sphere."""
    rig = load_rig()
    scene = _scene(rig, sphere(RADIUS_MM))
    rows, maps = [], {}
    for subset in (21, 33):
        for noise in (0.0, 2.0):
            found = _measure(rig, scene, None, subset=subset, noise=noise, seed=3)
            label = f"{subset} px, noise {noise:g}"
            for patch, e in found.items():
                limit = 0.05 if patch != "affine" and subset == 21 else None
                rows.append(Row(f"sphere, {label}, {NAMES[patch]}: mean Z error", abs(float(e.z.mean())), "um", limit))
                rows.append(Row(f"sphere, {label}, {NAMES[patch]}: rms Z error", _rms(e.z), "um"))
            auto = found["auto"]
            rows.append(
                Row(
                    f"sphere, {label}: rms Z of auto over the better of both",
                    _rms(auto.z) / min(_rms(found["affine"].z), _rms(found["quadratic"].z)),
                    "",
                    1.1,
                )
            )
            lost = int((~found["quadratic"].field.valid & found["affine"].field.valid).sum())
            rows.append(Row(f"sphere, {label}: points that only plane patches keep", lost, "", 0 if noise else None))
            if subset == 21 and noise:
                maps = found
                curvature = found["quadratic"].field.curvature_per_mm
                assert curvature is not None
                k = curvature[found["quadratic"].field.valid]
                mean = k.mean(axis=1)
                rows += [
                    Row(
                        "mean curvature times R, 21 px, noise 2: departure from 1",
                        abs(mean.mean() * RADIUS_MM - 1),
                        "",
                        0.02,
                    ),
                    Row("mean curvature of a point, random", float(mean.std()), "1/mm"),
                ]
    _maps(figures / "accuracy_curved_sphere.png", maps)
    return Section(
        "Curved patches: shape of a sphere",
        f"Sphere of R = {RADIUS_MM:g} mm on the paper's rig, {maps['auto'].field.status.size} points. `plane` is the default "
        "patch, `auto` decides by itself.",
        rows,
        [("accuracy_curved_sphere.png", "Errors of Z on a sphere with plane and with curved patches, 21 px, noise 2")],
        [f'What `auto` says at 21 px and noise 2: "{maps["auto"].reason}".'],
    )


def _maps(path: Path, found: dict[PatchSetting, Errors]) -> None:
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained", gridspec_kw={"width_ratios": (1, 1, 0.9)})
    for ax, patch in zip(axes, ("affine", "quadratic"), strict=False):
        e = found[patch]
        mesh = ax.pcolormesh(
            e.field.x_px,
            e.field.y_px,
            np.where(e.field.valid, e.z_um, np.nan),
            shading="nearest",
            vmin=-3,
            vmax=3,
            cmap="RdBu_r",
        )
        ax.invert_yaxis()
        ax.set_aspect("equal")
        ax.set(title=f"{NAMES[patch]} patches", xlabel="x / px", ylabel="y / px")
    fig.colorbar(mesh, ax=axes[:2], label="error of Z / um")
    for patch in ("affine", "quadratic"):
        axes[2].hist(found[patch].z, bins=40, histtype="step", density=True, label=NAMES[patch])
    axes[2].axvline(0.0, color="k", lw=0.5)
    axes[2].set(xlabel="error of Z / um", ylabel="density")
    axes[2].legend()
    fig.savefig(path, dpi=110)
    plt.close(fig)


def noise_cost(figures: Path) -> Section:
    """What curved patches cost where nothing is curved."""
    rig = load_rig()
    rows: list[Row] = []
    bars: dict[int, dict[str, tuple[float, float]]] = {}
    for subset in (21, 33):
        sums: dict[str, list[Float]] = {"affine": [], "quadratic": []}
        sigmas: dict[str, list[Float]] = {"affine": [], "quadratic": []}
        means = []
        for seed in (1, 2, 3):
            before = plane_scene(rig.texture(seed))
            after = plane_scene(rig.texture(seed), motion=RigidTransform(np.eye(3), np.array([0.026, -0.014, 0.042])))
            found = _measure(
                rig, before, after, subset=subset, noise=2.0, seed=7 * seed, patches=("affine", "quadratic")
            )
            for patch, e in found.items():
                sums[patch].append(np.var(np.column_stack([e.uvw, e.z]), axis=0))
                variance = np.diagonal(e.field.covariance, axis1=-2, axis2=-1)[e.field.valid] * 1e6
                sigmas[patch].append(variance[:, [3, 4, 5, 2]].mean(0))
            means.append(np.abs(found["quadratic"].uvw.mean(0)))
        sd = {patch: np.sqrt(np.mean(v, axis=0)) for patch, v in sums.items()}
        reported = {patch: np.sqrt(np.mean(v, axis=0)) for patch, v in sigmas.items()}
        bars[subset] = {}
        for i, name in enumerate(("u", "v", "w", "Z")):
            one, two = float(sd["affine"][i]), float(sd["quadratic"][i])
            bars[subset][name] = one, two
            rows += [
                Row(f"{name} random, {subset} px, plane patches", one, "um"),
                Row(f"{name} random, {subset} px, curved patches", two, "um"),
                Row(f"{name} random, {subset} px: curved over plane", two / one, ""),
                Row(
                    f"{name}, {subset} px, curved: reported over empirical sd",
                    float(reported["quadratic"][i]) / two,
                    "",
                ),
            ]
        rows.append(Row(f"mean u, v, w, {subset} px, curved, worst of the fields", float(np.max(means)), "um", 0.06))
    fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for k, values in enumerate(bars.values()):
        x = np.arange(4) + 5 * k
        for j, label in enumerate(("plane", "quadratic")):
            ax.bar(x + 0.4 * j - 0.2, [v[j] for v in values.values()], 0.4, color=f"C{j}", label=None if k else label)
        for xi, (one, two) in zip(x, values.values(), strict=True):
            ax.text(xi + 0.2, two, f"{two / one:.2f}x", ha="center", va="bottom", fontsize=8)
    ax.set_ylim(top=1.12 * max(two for values in bars.values() for _, two in values.values()))
    ax.set_xticks([*range(4), *range(5, 9)], [f"{n}\n{s} px" for s in bars for n in bars[s]])
    ax.set(ylabel="random error / um", title="A plane that moves, noise 2 of 255")
    ax.legend()
    fig.savefig(figures / "accuracy_curved_noise.png", dpi=110)
    plt.close(fig)
    return Section(
        "Curved patches: the noise they cost",
        "A plane that shifts by 0.05 mm, three speckle patterns, noise 2. Shape is that of the reference pair alone.",
        rows,
        [("accuracy_curved_noise.png", "Random errors of plane and curved patches")],
        [
            "With gradients alike all over the subset, theory says that the six terms in place of three raise the standard deviation in "
            "the middle by the root of 3.5, 1.87 times."
        ],
    )


def bending(figures: Path) -> Section:
    """A flat sheet that bends to spheres of many radii."""
    rig = load_rig()
    radii = (1500.0, 600.0, 300.0, 150.0, 60.0, 30.0)
    shift = np.array([0.02, 0.01, -0.03])
    rows: list[Row] = []
    curves: dict[PatchSetting, list[float]] = {patch: [] for patch in PATCHES}
    chosen, worst = [], 0.0
    before = _scene(rig, flat())
    for radius in radii:
        after = _scene(rig, sphere(radius), shift_mm=shift)
        found = _measure(rig, before, after, subset=21, noise=2.0, seed=11)
        for patch, e in found.items():
            curves[patch].append(_rms(e.uvw))
        chosen.append(found["auto"].chosen)
        worst = max(worst, curves["auto"][-1] / min(curves["affine"][-1], curves["quadratic"][-1]))
        if radius in (300.0, 30.0):
            for patch in ("affine", "quadratic"):
                e = found[patch]
                rows.append(
                    Row(f"bent to R = {radius:g} mm, {NAMES[patch]}: mean w error", abs(e.uvw.mean(0)[2]), "um")
                )
                rows.append(Row(f"bent to R = {radius:g} mm, {NAMES[patch]}: rms of the error", _rms(e.uvw), "um"))
        if radius == radii[-1]:
            reason = found["auto"].reason
        if radius in (300.0, 30.0):
            choice, bias = found["affine"].field.patch, found["affine"].uvw.mean(0)
            assert choice is not None
            assert choice.plane_error_mm is not None
            ratio = 1e3 * choice.plane_error_mm / float(np.linalg.norm(bias))
            rows.append(
                Row(
                    f"bent to R = {radius:g} mm: plane patches' error, as the field estimates it, over the true one",
                    ratio,
                    "",
                )
            )
    clean = _measure(
        rig,
        before,
        _scene(rig, sphere(30.0), shift_mm=shift),
        subset=21,
        noise=0.0,
        seed=0,
        patches=("affine", "quadratic"),
    )
    for patch, e in clean.items():
        limit = 0.05 if patch == "quadratic" else None
        rows.append(
            Row(f"bent to R = 30 mm, noise-free, {NAMES[patch]}: mean w error", abs(e.uvw.mean(0)[2]), "um", limit)
        )
    rows.append(Row("rms of auto over the better of both, worst of the radii", worst, "", 1.15))
    fig, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    k = 1.0 / np.array(radii)
    ax.loglog(k, curves["affine"], "o-", label="plane (stretch)")
    ax.loglog(k, curves["quadratic"], "s-", label="quadratic")
    ax.loglog(k, curves["auto"], "k.", ms=14, mfc="none", label="auto")
    for x, y, name in zip(k, curves["auto"], chosen, strict=True):
        ax.annotate(name, (x, y), xytext=(0, 8), textcoords="offset points", ha="center", fontsize=7)
    ax.set(
        xlabel="curvature that comes with the motion / (1/mm)",
        ylabel="rms error of (u, v, w) / um",
        title="A flat sheet bends, 21 px, noise 2 of 255",
    )
    ax.set_ylim(0.2, 2.5)
    ax.set_yticks([0.2, 0.5, 1.0, 2.0], ["0.2", "0.5", "1", "2"], minor=False)
    ax.set_yticks([], minor=True)
    ax.legend()
    fig.savefig(figures / "accuracy_curved_bending.png", dpi=110)
    plt.close(fig)
    return Section(
        "Curved patches: a sheet that bends",
        "A flat sheet bends to spheres from R = 1500 mm to 30 mm and shifts by 0.04 mm; 21 px.",
        rows,
        [("accuracy_curved_bending.png", "Error against curvature for plane, curved and auto")],
        [f'What `auto` says at R = 30 mm: "{reason}".'],
    )


def choices(figures: Path) -> Section:
    """What `auto` takes on the specimens, and what it is worth."""
    paper, panel = load_rig(), load_rig("sim_panel")
    sims = {name: SimRig.from_toml(ROOT / "config" / f"{name}.toml") for name in ("sim_paper", "sim_panel")}

    def specimen(rig: str, name: str, load: float, **more: Any) -> Scene:
        return make_scene(sims[rig], name, load=load, **more)

    turn = {"translation_mm": (0.05, -0.03, 0.08), "rotation_rad": (0.004, -0.006, 0.01)}
    cases: list[tuple[str, Rig, Scene, Scene | None, PointGrid]] = [
        ("plane, shape", paper, plane_scene(paper.texture(1)), None, _grid()),
        (
            "block, moved",
            paper,
            specimen("sim_paper", "block", 0.0, **turn),
            specimen("sim_paper", "block", 1.0, **turn),
            _grid(),
        ),
        ("strip, 2 % strain", paper, specimen("sim_paper", "strip", 0.0), specimen("sim_paper", "strip", 2.0), _grid()),
        ("sphere, shape", paper, specimen("sim_paper", "sphere", 0.0, **turn), None, _grid()),
        (
            "sphere, moved",
            paper,
            specimen("sim_paper", "sphere", 0.0, **turn),
            specimen("sim_paper", "sphere", 1.0, **turn),
            _grid(),
        ),
        ("plate, 689 kPa", paper, specimen("sim_paper", "plate", 0.0), specimen("sim_paper", "plate", 689.0), _grid()),
        (
            "panel, 48.95 kN",
            panel,
            specimen("sim_panel", "panel", 0.0),
            specimen("sim_panel", "panel", 48.95),
            _grid(12, (80, 60, panel.size_px[0] - 80, panel.size_px[1] - 60)),
        ),
    ]
    rows, notes, bars = [], [], []
    for label, rig, before, after, grid in cases:
        found = _measure(rig, before, after, subset=33, noise=2.0, seed=5, grid=grid)
        error = {patch: _rms(e.z if after is None else e.uvw) for patch, e in found.items()}
        bars.append((label, error, found["auto"].chosen))
        better = min(error["affine"], error["quadratic"])
        rows += [
            Row(f"{label}: plane, rms", error["affine"], "um"),
            Row(f"{label}: curved, rms", error["quadratic"], "um"),
            Row(f"{label}: auto, rms over the better of both", error["auto"] / better, "", 1.15),
        ]
        notes.append(f'{label}: "{found["auto"].reason}".')
    fig, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
    for j, patch in enumerate(PATCHES):
        ax.bar(np.arange(len(bars)) + 0.27 * (j - 1), [b[1][patch] for b in bars], 0.27, label=NAMES[patch])
    ax.set_xticks(range(len(bars)), [f"{b[0]}\nauto: {b[2]}" for b in bars], fontsize=7)
    ax.set(yscale="log", ylabel="rms error / um", title="Z of shapes, (u, v, w) of motions; 33 px, noise 2 of 255")
    ax.legend()
    fig.savefig(figures / "accuracy_curved_choices.png", dpi=110)
    plt.close(fig)
    return Section(
        "Curved patches: what auto takes",
        "33 px, the default; rms of Z for shapes, of (u, v, w) for motions. What `auto` said of each stands below.",
        rows,
        [("accuracy_curved_choices.png", "Errors with plane, curved and auto patches on seven specimens")],
        notes,
    )


SECTIONS = {
    "curved-sphere": sphere_shape,
    "curved-noise": noise_cost,
    "curved-bending": bending,
    "curved-auto": choices,
}
