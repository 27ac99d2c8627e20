"""Comparison with a model through rendered images: right models accepted, a stiffness wrong by 2 % refuted.

The pictures are made here, from the cameras and the formulas alone: the ray of each of nine places in a pixel is met with
the displaced surface by fixed-point iteration, and the speckle, a spline over the material's own coordinates, is read
there. Nothing of the field, of its noise or of the model's mesh is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.stats import binomtest

from stereorig.core.cameras.camera import Camera
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.model.compare import compare_with_model
from stereorig.core.model.placement import place_given
from stereorig.core.model.result import ModelComparison
from tests.bench.accuracy.models import CASES, STIFFNESS
from tests.bench.accuracy.paper_rig import BRIGHT, DARK, Rig, load_rig
from tests.bench.accuracy.table import Row, Section
from tests.support.model_bench import Array, mesh

SUBSET, STEP, NOISE = 31, 12, 2.0
RECT = (50, 50, 450, 430)  # of camera 1's picture
TEXTURES, COPIES = 12, 5
KNOT_MM = 0.016  # half a pixel
HALF_MM = 11.0
_TURNS = 8  # of the iteration: each divides the error by the strain, 1e-2 at most


@dataclass(frozen=True)
class _State:
    """Where the rays of a picture meet the material: (h, w, 9, 2) coordinates on the undeformed plane, mm."""

    material_mm: Array


@cache
def _speckle(seed: int) -> Array:
    """A spline of a random pattern, levels 0 to 1, over a square of the material."""
    count = round(2.0 * HALF_MM / KNOT_MM)
    pattern = gaussian_filter(np.random.default_rng([23, seed]).standard_normal((count, count)), 0.06 / KNOT_MM)
    return np.asarray(spline_filter(0.5 + 0.5 * np.tanh(1.3 * pattern / pattern.std()), order=3))


def _state(camera: Camera, size_px: tuple[int, int], displacement: Callable[[Array], Array] | None) -> _State:
    """Meet the rays with the displaced plane Z = 0."""
    width, height = size_px
    offset = (np.arange(3) - 1.0) / 3.0
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    px = np.stack(np.broadcast_arrays(x[..., None, None] + offset, y[..., None, None] + offset[:, None]), axis=-1)
    rays = camera.rays_cam(px.reshape(-1, 2)).xyz_mm
    pose = camera.cam_from_sys
    direction = rays @ pose.rotation
    centre = -pose.rotation.T @ pose.translation_mm
    material = np.zeros((len(rays), 3))
    moved = np.zeros_like(material)
    for _ in range(_TURNS):
        t = (moved[:, 2] - centre[2]) / direction[:, 2]
        met = centre + t[:, None] * direction
        material[:, :2] = met[:, :2] - moved[:, :2]
        if displacement is None:
            break
        moved = displacement(material)
    return _State(material[:, :2].reshape(height, width, 9, 2))


def _picture(state: _State, seed: int, hole_mm: float, gain: float) -> Array:
    """Grey levels without noise: the mean over a pixel, then the lens' blur; dark behind a hole."""
    at = (state.material_mm + HALF_MM) / KNOT_MM
    bright = map_coordinates(_speckle(seed), [at[..., 1], at[..., 0]], order=3, mode="mirror", prefilter=False)
    if hole_mm > 0.0:
        bright = np.where(np.hypot(state.material_mm[..., 0], state.material_mm[..., 1]) < hole_mm, 0.0, bright)
    return np.asarray(gain * (DARK + (BRIGHT - DARK) * gaussian_filter(bright.mean(axis=-1), 0.6)))


def _grid(rig: Rig, hole_mm: float) -> PointGrid:
    """Points whose subsets lie on the material."""
    x0, y0, x1, y1 = RECT
    mask = np.zeros((rig.size_px[1], rig.size_px[0]), dtype=bool)
    mask[y0:y1, x0:x1] = True
    if hole_mm > 0.0:
        at = _state(rig.pair.cam1, rig.size_px, None).material_mm[:, :, 4]
        reach = 0.75 * SUBSET * 0.033
        mask &= np.hypot(at[..., 0], at[..., 1]) > hole_mm + reach
    return PointGrid.mask(mask, spacing_px=STEP)


def _measured(rig: Rig, clean: list[Array], grid: PointGrid, rng: np.random.Generator) -> Field:
    noisy = [np.clip(np.rint(c + rng.normal(0.0, NOISE, c.shape)), 0, 255).astype(np.uint8) for c in clean]
    images = [MeasureImage(image, name) for image, name in zip(noisy, ("a1", "a2", "b1", "b2"), strict=True)]
    options = MeasureOptions(subset_px=SUBSET)
    reference = ReferencePair(rig.pair, *images[:2])
    shape = reference.shape(grid, options)
    return reference.motion(*images[2:], grid, options, shape=shape)


def _case(
    rig: Rig, of: Callable[[float], Callable[[Array], Array]], hole_mm: float, rng: np.random.Generator
) -> tuple[list[ModelComparison], list[ModelComparison]]:
    """Replicates against the right model, and the same against the wrong one."""
    cameras = (rig.pair.cam1, rig.pair.cam2)
    states = [_state(camera, rig.size_px, motion) for motion in (None, of(1.0)) for camera in cameras]
    right, wrong = (mesh(of(stiffness), half_mm=10.0, hole_mm=hole_mm) for stiffness in (1.0, STIFFNESS))
    grid = _grid(rig, hole_mm)
    accepted, refuted = [], []
    for seed in range(TEXTURES):
        clean = [_picture(state, seed, hole_mm, gain) for state, gain in zip(states, (1.0, 0.88) * 2, strict=True)]
        for _ in range(COPIES):
            field = _measured(rig, clean, grid, rng)
            placed = place_given(np.eye(3), np.zeros(3), field)
            accepted.append(compare_with_model(field, right, placed, subset_px=SUBSET))
            refuted.append(compare_with_model(field, wrong, placed, subset_px=SUBSET))
    return accepted, refuted


def models_images(figures: Path) -> Section:
    """Measure every figure of the section."""
    rig, rng = load_rig(), np.random.default_rng(23)
    rows, shown = [], []
    number = TEXTURES * COPIES
    for name, of, hole in CASES:
        right, wrong = _case(rig, of, hole, rng)
        rows.append(
            Row(
                f"{name}: points compared",
                float(np.mean([np.isfinite(c.displacement.z[..., 0]).sum() for c in right])),
                "1",
            )
        )
        taken = sum(c.accepted for c in right)
        interval = binomtest(taken, number).proportion_ci(0.95)
        rows.append(Row(f"{name}: right model accepted, of {number}", taken / number, "1", 0.9, at_least=True))
        rows.append(Row(f"{name}: the same, upper end of its 95 % interval", interval.high, "1", 0.95, at_least=True))
        z = [(c.factor - 1.0) / c.factor_sigma for c in right]
        rows.append(Row(f"{name}: mean of the factor less 1", float(np.mean([c.factor for c in right])) - 1.0, "1"))
        sigma = float(np.mean([c.factor_sigma for c in right]))
        rows.append(Row(f"{name}: standard uncertainty of the factor", sigma, "1"))
        rows.append(Row(f"{name}: factor's error over it, rms", float(np.sqrt(np.mean(np.square(z)))), "1", 1.4))
        chi = [c.displacement.overall.chi_square / c.displacement.overall.degrees for c in right]
        rows.append(Row(f"{name}: chi-square over its degrees of freedom, mean", float(np.mean(chi)), "1"))
        refuted = float(np.mean([not c.accepted for c in wrong]))
        rows.append(Row(f"{name}: stiffness wrong by 2 % refuted, of {number}", refuted, "1", 0.95, at_least=True))
        shown.append((name, right, wrong))
    _draw(shown, figures / "accuracy_models_images.png")
    return Section(
        "Comparison with a model, through images",
        f"The same two cases on the paper's rig, seen by its cameras: {TEXTURES} speckle patterns, {COPIES} times new noise "
        f"of {NOISE:g} grey levels in all four pictures of each; {SUBSET} px subsets, step {STEP} px, calibration exact. The "
        "pictures are made from the formulas by a renderer of their own (tests/bench/accuracy/models_images.py).",
        rows,
        [
            (
                "accuracy_models_images.png",
                "Measured over modelled displacement, right and 2 % too stiff; z of one replicate",
            )
        ],
        [
            "Each verdict is on a new measurement: the wrong model is compared with the same fields as the right one. Interpolation and "
            "rounding are in these fields; no systematic size was stated for them."
        ],
    )


def _draw(shown: list[tuple[str, list[ModelComparison], list[ModelComparison]]], path: Path) -> None:
    fig, axes = plt.subplots(1, 1 + len(shown), figsize=(11.0, 3.6))
    for k, (_, right, wrong) in enumerate(shown):
        for found, label, colour in ((right, "right", "C0"), (wrong, "2 % too stiff", "C3")):
            at = np.full(len(found), k) + (0.0 if label == "right" else 0.25) + np.linspace(-0.08, 0.08, len(found))
            error = [2.0 * c.factor_sigma for c in found]
            own = label if k == 0 else None
            axes[0].errorbar(at, [c.factor for c in found], error, fmt=".", color=colour, lw=0.6, ms=3, label=own)
    axes[0].axhline(1.0, color="k", lw=0.8)
    axes[0].set(ylabel="factor, ± 2 u", xticks=[0.12 + k for k in range(len(shown))])
    axes[0].set_xticklabels([name for name, _, _ in shown])
    axes[0].legend()
    for ax, (name, _, wrong), component in zip(axes[1:], shown, (2, 0), strict=True):
        image = ax.imshow(wrong[0].displacement.z[..., component], cmap="RdBu_r", vmin=-4, vmax=4)
        ax.set(xticks=[], yticks=[])
        ax.set_title(f"{name}: z of {'uvw'[component]}, 2 % too stiff", fontsize=9)
        fig.colorbar(image, ax=ax)
    fig.tight_layout()
    fig.savefig(path, dpi=110)
    plt.close(fig)


SECTIONS: dict[str, Callable[[Path], Section]] = {"models-images": models_images}
