"""Gauges on repeated noisy pictures: do extensometers, means and rigid motions scatter as they say?"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.region import PointGrid
from stereorig.core.gauge.area import area_statistics, points_within
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.reading import Reading
from stereorig.core.gauge.rigid import rigid_motion
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.bench.accuracy.paper_rig import load_rig, plane_scene, turn
from tests.bench.accuracy.table import Row, Section

SUBSET, STEP, NOISE = 33, 8, 2.0
GRID = PointGrid.rectangle(220, 200, 220 + 8 * STEP, 200 + 6 * STEP, spacing_px=STEP)
COPIES = 200
SHARED = SharedPixels(SUBSET)
LAGS = tuple((dx, dy) for dy in range(6) for dx in range(6))


def _copies() -> list[Field]:
    rig = load_rig()
    motion = turn(np.array([1.0, 1.0, 2.0]), np.radians(0.3))
    after = plane_scene(rig.texture(1), motion=RigidTransform(motion.rotation, np.array([0.05, -0.03, 0.1])))
    clean = [np.asarray(v) for s in (plane_scene(rig.texture(1)), after) for v in rig.capture(s, noise=0.0)]
    rng = np.random.default_rng(17)
    options = MeasureOptions(subset_px=SUBSET, patch="affine")
    seeds = GRID.xy_px[3:4, 4]
    out = []
    for _ in range(COPIES):
        noisy = [np.clip(np.rint(c + rng.normal(0.0, NOISE, c.shape)), 0, 255).astype(np.uint8) for c in clean]
        images = [MeasureImage(image, name) for image, name in zip(noisy, ("a1", "a2", "b1", "b2"), strict=True)]
        reference = ReferencePair(rig.pair, *images[:2])
        shape = reference.shape(GRID, options, seeds=seeds)
        field = reference.motion(*images[2:], GRID, options, shape=shape, seeds=seeds)
        if field.valid.all():  # a mean over other points is another quantity
            out.append(field)
    return out


def _mean(field: Field, component: int) -> Reading:
    values = np.concatenate([field.xyz_mm, field.uvw_mm], axis=-1)[..., component]
    got = area_statistics(field, values, field.sigma_mm[..., component], points_within(field, None), shared=SHARED)
    return Reading(got.mean, got.mean_sigma)


def _gauges(field: Field) -> dict[str, Reading]:
    near = extensometer(field, (224, 205), (240, 213), shared=SHARED)
    far = extensometer(field, (224, 205), (280, 240), shared=SHARED)
    motion = rigid_motion(field, shared=SHARED)
    sigma = np.sqrt(np.diag(motion.covariance))
    out = {
        "extensometer of 66 px, length": far.length0_mm,
        "extensometer of 66 px, elongation": far.elongation_mm,
        "extensometer of 18 px, length": near.length0_mm,
        "extensometer of 18 px, elongation": near.elongation_mm,
        "mean of z over 63 points": _mean(field, 2),
        "mean of u over 63 points": _mean(field, 3),
        "mean of v over 63 points": _mean(field, 4),
        "mean of w over 63 points": _mean(field, 5),
    }
    for k, axis in enumerate("xyz"):
        out[f"rigid motion, rotation about {axis}"] = Reading(motion.rotation_vector_rad[k], sigma[k])
        out[f"rigid motion, translation along {axis}"] = Reading(motion.translation_mm[k], sigma[3 + k])
    return out


def gauges(figures: Path) -> Section:
    """Measure every figure of the section."""
    fields = _copies()
    read = [_gauges(field) for field in fields]
    rows = [Row("pictures' copies with all points valid", float(len(fields)), "")]
    ratios = []
    for name in read[0]:
        values, sigmas = (np.array([getattr(r[name], part) for r in read]) for part in ("value", "sigma"))
        ratios.append(float(values.std(ddof=1) / np.sqrt(np.mean(sigmas**2))))
        rows.append(Row(f"{name}: empirical over reported standard deviation", ratios[-1], "1"))
    rows.append(Row("all of these, root mean square", float(np.sqrt(np.mean(np.square(ratios)))), "1", 1.05))
    rows.append(_correlations(fields, figures / "accuracy_gauges.png"))
    return Section(
        "Gauges",
        f"A plane on the paper's rig, moved and turned; {COPIES} noisy copies of the pictures; {SUBSET} px subsets, step "
        f"{STEP} px. A ratio of scatters from {COPIES} copies has a chance error of 5 %.",
        rows,
        [("accuracy_gauges.png", "Correlation of two points' errors over the pixels that their subsets share")],
        [
            "Subsets 18 px apart share a good part of their pixels: taken as independent, the same elongation would be given "
            "a larger sigma and the mean over an area a smaller one."
        ],
    )


def _correlations(fields: list[Field], path: Path) -> Row:
    errors = np.array([np.concatenate([f.xyz_mm, f.uvw_mm], axis=-1) for f in fields])
    errors = (errors - errors.mean(axis=0)) / errors.std(axis=0)

    def seen(dx: int, dy: int) -> Float:
        _, rows, cols, _ = errors.shape
        return (errors[:, dy:, dx:] * errors[:, : rows - dy, : cols - dx]).mean(axis=(0, 1, 2))

    def model(dx: int, dy: int) -> float:
        return float(SHARED.correlation(dx * STEP, dy * STEP))

    found = np.array([seen(*lag)[2:] for lag in LAGS])  # z, u, v, w; x and y of a pixel hang on its ray
    expected = np.array([model(*lag) for lag in LAGS])
    fig, ax = plt.subplots(figsize=(5.5, 4.0))
    for k, name in enumerate("zuvw"):
        ax.plot(expected, found[:, k], ".", label=name)
    ax.plot([0, 1], [0, 1], "k-", lw=0.8)
    ax.set(xlabel="share of common pixels", ylabel="correlation, measured")
    ax.legend()
    fig.tight_layout()
    fig.savefig(path, dpi=110)
    plt.close(fig)
    off = np.abs(found - expected[:, None])
    return Row("correlation of neighbours less the share of pixels, mean size", float(off.mean()), "1")


SECTIONS: dict[str, Callable[[Path], Section]] = {"gauges": gauges}
