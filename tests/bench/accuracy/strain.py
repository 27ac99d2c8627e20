"""Strain over a virtual gauge: false strain of rigid motions, even strain, its noise, and the patch's own strain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.strain import StrainField, StrainOptions, surface_strain
from stereorig.sim.scene import UPRIGHT, Scene
from tests.bench.accuracy.paper_rig import Rig, load_rig, plane_scene, turn
from tests.bench.accuracy.table import Row, Section

REGION = (90, 90, 420, 390)
SUBSET = 33
NAMES = ("exx", "eyy", "exy")
WINDOWS = (3, 5, 9, 15)
MICRO = 1e6


@dataclass(frozen=True)
class Case:
    """A motion, its pictures' noise, and the true Green-Lagrange strain."""

    name: str
    motion: RigidTransform
    in_plane: Float | None = None

    @property
    def truth(self) -> Float:
        """exx, eyy, exy of 1/2 (F^T F - I)."""
        if self.in_plane is None:
            return np.zeros(3)
        to_sys = UPRIGHT.rotation[:2, :2]  # the body lies at 45 degrees to the system's axes
        e = to_sys @ (0.5 * (self.in_plane.T @ self.in_plane - np.eye(2))) @ to_sys.T
        return np.array([e[0, 0], e[1, 1], e[0, 1]])


def _moved(
    shift: tuple[float, float, float], axis: tuple[float, float, float] = (0, 0, 1), deg: float = 0.0
) -> RigidTransform:
    motion = turn(np.array(axis, float), np.radians(deg))
    return RigidTransform(motion.rotation, np.array(shift))


RIGID = (
    Case("5 mm out of plane", _moved((0.0, 0.0, 5.0))),
    Case("10 degrees in plane", _moved((0.0, 0.0, 0.0), (0, 0, 1), 10.0)),
    Case("10 degrees of tilt", _moved((0.0, 0.0, 0.0), (0, 1, 0), 10.0)),
    Case("5 mm out of plane and 10 degrees in plane", _moved((0.0, 0.0, 5.0), (0, 0, 1), 10.0)),
    Case("5 mm out of plane and 10 degrees about a slanted axis", _moved((0.0, 0.0, 5.0), (1, 1, 2), 10.0)),
)


def _fields(
    rig: Rig, before: Scene, after: Scene, *, noise: float, seeds: tuple[int, ...], step: int = 10
) -> list[Field]:
    grid = PointGrid.rectangle(*REGION, spacing_px=step)
    options = MeasureOptions(subset_px=SUBSET)
    out = []
    for seed in seeds:
        reference = ReferencePair(rig.pair, *rig.capture(before, noise=noise, seed=seed))
        shape = reference.shape(grid, options)
        out.append(reference.motion(*rig.capture(after, noise=noise, seed=seed + 1000), grid, options, shape=shape))
    return out


def _strain(field: Field, window: int = 9, order: int = 1) -> StrainField:
    return surface_strain(field, StrainOptions(window=window, order=2 if order == 2 else 1), subset_px=SUBSET)


def strains(figures: Path) -> Section:
    """Measure every figure of the section."""
    rig = load_rig()
    rows: list[Row] = []
    maps: dict[str, StrainField] = {}
    for case in RIGID:
        before, after = plane_scene(rig.texture(1)), plane_scene(rig.texture(1), motion=case.motion)
        for noise in (0.0, 2.0):
            strain = _strain(_fields(rig, before, after, noise=noise, seeds=(3,))[0])
            mean = np.abs(strain.strain[strain.valid].mean(axis=0))
            label = "noise-free" if noise == 0 else "noise 2"
            rows.append(
                Row(f"false strain, {case.name}, {label}: mean, worst component", MICRO * float(mean.max()), "ue", 20.0)
            )
            if noise == 0:
                worst = np.abs(strain.strain[strain.valid]).max()
                rows.append(Row(f"false strain, {case.name}, {label}: worst point", MICRO * float(worst), "ue"))
        maps[case.name] = strain
    rows += _even_strain(rig)
    noise_rows, curve = _noise(rig)
    rows += noise_rows
    _plot(figures / "accuracy_strain_false.png", maps)
    _plot_noise(figures / "accuracy_strain_noise.png", curve)
    return Section(
        "Strain over a virtual gauge",
        f"A plane on the paper's rig with the true calibration, {SUBSET} px subsets, step 10 px; Green-Lagrange strain over "
        "9 points (113 px, 4.1 mm) unless a row says otherwise. ue: microstrain.",
        rows,
        [
            ("accuracy_strain_false.png", "False strain exx after rigid motions, noise 2"),
            ("accuracy_strain_noise.png", "Noise of exx against the gauge's width"),
        ],
        [
            "The reported uncertainty rests on the points' covariances and on the share of pixels that neighbouring subsets have in "
            "common. Empirical scatter is that of repeated noisy pictures, point by point."
        ],
    )


def _even_strain(rig: Rig) -> list[Row]:
    rows = []
    for percent, shear in ((0.1, 0.0003), (5.0, 0.01)):
        F = np.array([[1 + percent / 100, shear], [0.0, 1 - 0.3 * percent / 100]])
        case = Case(f"{percent:g} %", _moved((0.03, -0.02, 0.05), (1, 1, 2), 2.0), F)
        before = plane_scene(rig.texture(2))
        after = plane_scene(rig.texture(2), in_plane=F, motion=case.motion)
        strain = _strain(_fields(rig, before, after, noise=2.0, seeds=(4,))[0])
        off = np.abs(strain.strain[strain.valid].mean(axis=0) - case.truth)
        rows.append(
            Row(
                f"{percent:g} % of even strain, turned by 2 degrees: mean error, worst component",
                MICRO * float(off.max()),
                "ue",
                20.0,
            )
        )
        assert strain.patch is not None
        patch = strain.patch[strain.valid]
        rows.append(
            Row(
                f"{percent:g} % of even strain: mean error of the patches' own strain",
                MICRO * float(np.abs(patch.mean(axis=0) - case.truth).max()),
                "ue",
            )
        )
        rows.append(
            Row(
                f"{percent:g} % of even strain: sd of gauge, exx",
                MICRO * float(strain.strain[strain.valid][:, 0].std()),
                "ue",
            )
        )
        rows.append(
            Row(
                f"{percent:g} % of even strain: sd of the patches' own strain, exx",
                MICRO * float(patch[:, 0].std()),
                "ue",
            )
        )
    return rows


def moved_fields(rig: Rig, repeats: int) -> list[Field]:
    """Measure a plane's small motion from repeated noisy pictures."""
    before = plane_scene(rig.texture(3))
    after = plane_scene(rig.texture(3), motion=_moved((0.026, -0.014, 0.042)))
    clean = rig.capture(before, noise=0.0), rig.capture(after, noise=0.0)
    grid = PointGrid.rectangle(*REGION, spacing_px=10)
    options = MeasureOptions(subset_px=SUBSET, patch="affine")
    fields = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        noisy = [
            [np.clip(np.round(image + rng.normal(0.0, 2.0, image.shape)), 0, 255).astype(np.uint8) for image in both]
            for both in clean
        ]
        reference = ReferencePair(rig.pair, *noisy[0])
        fields.append(reference.motion(*noisy[1], grid, options, shape=reference.shape(grid, options)))
    return fields


def _noise(rig: Rig, repeats: int = 12) -> tuple[list[Row], dict[int, tuple[float, float, float]]]:
    """Scatter of repeated noisy pictures against the reported uncertainty, for several windows."""
    fields = moved_fields(rig, repeats)
    rows, curve = [], {}
    for window in WINDOWS:
        found = [_strain(f, window) for f in fields]
        kept = np.logical_and.reduce([s.valid for s in found])
        scatter = np.sqrt(np.mean(np.var([s.strain[kept] for s in found], axis=0, ddof=1), axis=0))
        reported = np.sqrt(np.mean([s.sigma[kept] ** 2 for s in found], axis=(0, 1)))
        curve[window] = (found[0].gauge_mm, MICRO * float(scatter[0]), MICRO * float(reported[0]))
        for k, name in enumerate(NAMES):
            if window == 9 or k == 0:
                rows.append(
                    Row(
                        f"noise of {name}, {window} points ({found[0].gauge_mm:.2g} mm)",
                        MICRO * float(scatter[k]),
                        "ue",
                    )
                )
                rows.append(
                    Row(f"{name}, {window} points: reported over empirical sd", float(reported[k] / scatter[k]), "")
                )
    patches = [s.patch for s in found]
    scatter = np.sqrt(np.mean(np.var([p[kept] for p in patches if p is not None], axis=0, ddof=1), axis=0))
    rows.append(Row(f"noise of the patches' own exx ({SUBSET} px)", MICRO * float(scatter[0]), "ue"))
    return rows, curve


def _plot(path: Path, maps: dict[str, StrainField]) -> None:
    fig, axes = plt.subplots(1, len(maps), figsize=(12, 3.0), layout="constrained")
    for ax, (name, strain) in zip(axes, maps.items(), strict=True):
        mesh = ax.imshow(MICRO * strain.strain[..., 0], cmap="RdBu_r", vmin=-150, vmax=150)
        ax.set_title(name.replace(" and ", "\nand "), fontsize=8)
        ax.set_xticks([])
        ax.set_yticks([])
    fig.colorbar(mesh, ax=axes, label="false exx / microstrain")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def _plot_noise(path: Path, curve: dict[int, tuple[float, float, float]]) -> None:
    fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    gauge, scatter, reported = np.array(list(curve.values())).T
    ax.loglog(gauge, scatter, "o", label="scatter of repeated pictures")
    ax.loglog(gauge, reported, "k-", lw=0.8, label="reported")
    for window, x, y in zip(curve, gauge, scatter, strict=True):
        ax.annotate(f"{window} points", (x, y), xytext=(4, 6), textcoords="offset points", fontsize=7)
    ax.set(
        xlabel="width of the gauge / mm",
        ylabel="sd of exx / microstrain",
        title=f"{SUBSET} px subsets, step 10 px, noise 2 of 255",
    )
    ax.set_xlim(1.7, 8.0)
    ax.set_ylim(8.0, 150.0)
    ax.set_xticks([2, 3, 4, 6], ["2", "3", "4", "6"])
    ax.set_yticks([10, 20, 50, 100], ["10", "20", "50", "100"])
    ax.minorticks_off()
    ax.legend()
    fig.savefig(path, dpi=110)
    plt.close(fig)


RADII_MM = (1000.0, 500.0, 200.0, 100.0, 50.0, 30.0)
MM_PER_PX = 0.0363  # of the gauge's 113 px and 4.1 mm
POINT_SD_MM = 1e-4  # of u and v, 33 px, noise 2


def _rolled(radius_mm: float, rng: np.random.Generator | None = None) -> Field:
    """A flat sheet rolled up along its columns without any strain, exactly; with the points' noise if asked for."""
    x, y = np.meshgrid(10.0 * np.arange(31), 10.0 * np.arange(25))
    s = MM_PER_PX * (x - x.mean())
    flat = np.stack([s, MM_PER_PX * (y - y.mean()), np.zeros_like(s)], axis=-1)
    rolled = np.stack([radius_mm * np.sin(s / radius_mm), flat[..., 1], radius_mm * (1.0 - np.cos(s / radius_mm))], -1)
    zero, ones = np.zeros(x.shape), np.ones((*x.shape, 3))
    moved = rolled - flat
    if rng is not None:
        moved = moved + POINT_SD_MM * rng.normal(size=moved.shape)
    return Field(
        x_px=x,
        y_px=y,
        status=np.zeros(x.shape, np.int8),
        xyz_mm=flat,
        normal_sys=ones * [0.0, 0.0, -1.0],
        theta_rad=zero,
        phi_rad=zero,
        zp_mm=zero,
        zncc=ones,
        epipolar_px=zero,
        iterations=np.ones(x.shape, np.int32),
        noise_grey=zero,
        covariance=np.broadcast_to(POINT_SD_MM**2 * np.eye(6), (*x.shape, 6, 6)),
        uvw_mm=moved,
        rotation_rad=0.0 * ones,
        stretch=0.0 * ones,
    )


def bending(figures: Path) -> Section:
    """What is left of chords for arcs where a sheet is bent without strain."""
    rows, curves = [], {}
    for window in (5, 9, 15):
        half = window // 2
        s = 10.0 * MM_PER_PX * np.arange(-half, half + 1)
        without, left, edge = [], [], []
        for radius in RADII_MM:
            strain = _strain(_rolled(radius), window)
            without.append(MICRO * float((s**4).sum() / (s**2).sum() / (6.0 * radius**2)))
            whole = np.zeros(strain.valid.shape, bool)
            whole[half:-half, half:-half] = True
            left.append(MICRO * float(np.abs(strain.strain[strain.valid & whole]).max()))
            edge.append(MICRO * float(np.abs(strain.strain[strain.valid & ~whole]).max()))
            if window == 9:
                head = f"flat sheet rolled up to R = {radius:g} mm, 9 points"
                rows.append(Row(f"{head}: a plane's exx would be too little by", without[-1], "ue"))
                rows.append(Row(f"{head}: largest false strain, whole windows", left[-1], "ue", 1.0))
                rows.append(Row(f"{head}: largest false strain, windows that an edge has cut", edge[-1], "ue"))
        curves[window] = np.array([without, left, edge])
    noisy = np.array([_strain(_rolled(100.0, np.random.default_rng(k))).strain for k in range(40)])
    mean = MICRO * float(np.abs(np.nanmean(noisy, axis=(0, 1, 2))).max())
    scatter = MICRO * np.nanmean(np.nanstd(noisy[:, 4:-4, 4:-4], axis=0, ddof=1), axis=(0, 1))
    flat = np.array([_strain(_rolled(1e6, np.random.default_rng(k))).strain for k in range(40)])
    plain = MICRO * np.nanmean(np.nanstd(flat[:, 4:-4, 4:-4], axis=0, ddof=1), axis=(0, 1))
    rows.append(
        Row("R = 100 mm, 9 points, noise of 0.1 um a point: mean false strain, worst component", mean, "ue", 1.0)
    )
    rows.append(
        Row("scatter of exx there over that of a sheet that stays flat", float(scatter[0] / plain[0]), "", 1.05)
    )
    fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    for i, (window, (without, left, edge)) in enumerate(curves.items()):
        ax.loglog(RADII_MM, without, ":", color=f"C{i}")
        ax.loglog(RADII_MM, left, "o-", color=f"C{i}", label=f"{window} points")
        ax.loglog(RADII_MM, edge, "x--", color=f"C{i}", lw=0.8, markersize=4)
    ax.set(
        xlabel="radius after bending / mm",
        ylabel="false strain / microstrain",
        title="full: left; dashed: at edges; dotted: planes alone",
    )
    ax.legend(fontsize=8)
    fig.savefig(figures / "accuracy_strain_bending.png", dpi=110)
    plt.close(fig)
    return Section(
        "Strain of a surface that bends",
        "Exact positions of a flat sheet rolled up without strain, no pictures: a gauge's plane takes chords for arcs, and the windows' "
        "curvature says how much to put back. Points 10 px apart, 36 um a pixel.",
        rows,
        [("accuracy_strain_bending.png", "False strain where a flat sheet bends, against the radius")],
        [],
    )


SECTIONS = {"strains": strains, "strain-bending": bending}
