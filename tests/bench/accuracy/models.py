"""Comparison with a model on drawn noise: how often is the right model accepted, and one of wrong stiffness refuted?"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import binomtest

from stereorig.core.model.compare import compare_with_model
from stereorig.core.model.placement import place_given
from stereorig.core.model.result import ModelComparison
from stereorig.core.model.surface import ModelSurface
from stereorig.core.strain.options import StrainOptions
from tests.bench.accuracy.table import Row, Section
from tests.support.model_bench import SUBSET_PX, Array, Bench, bench, clamped_plate, kirsch, mesh

RIGHT, WRONG = 120, 60
SHAPE = (41, 41)
HOLE_MM, STRESS_MPA = 2.0, 120.0
STIFFNESS = 1.02


def _plate(stiffness: float) -> Callable[[Array], Array]:
    return clamped_plate(stiffness)


def _hole(stiffness: float) -> Callable[[Array], Array]:
    return kirsch(stiffness, radius_mm=HOLE_MM, stress_mpa=STRESS_MPA)


#: name, displacement by stiffness, radius of the hole
CASES = (("clamped plate", _plate, 0.0), ("plate with a hole", _hole, HOLE_MM))


def _compared(one: Bench, model: ModelSurface, rng: np.random.Generator, *, strain: bool) -> ModelComparison:
    field = one.replicate(rng)
    placed = place_given(np.eye(3), np.zeros(3), field)
    window = StrainOptions(window=7) if strain else None
    return compare_with_model(field, model, placed, subset_px=SUBSET_PX, strain=window)


def models(figures: Path) -> Section:
    """Measure every figure of the section."""
    rows, rng, shown = [], np.random.default_rng(23), []
    for name, of, hole in CASES:
        one = bench(of(1.0), shape=SHAPE, hole_mm=hole)
        right = mesh(of(1.0), half_mm=8.0, hole_mm=hole)
        wrong = mesh(of(STIFFNESS), half_mm=8.0, hole_mm=hole)
        assert one.field.uvw_mm is not None
        peak = 1e3 * float(np.nanmax(np.linalg.norm(one.field.uvw_mm, axis=-1)))
        rows.append(Row(f"{name}: largest displacement", peak, "um"))
        found = [_compared(one, right, rng, strain=k < RIGHT // 4) for k in range(RIGHT)]
        taken = sum(c.displacement.overall.probability > 0.05 for c in found)
        interval = binomtest(taken, RIGHT).proportion_ci(0.95)
        rows.append(Row(f"{name}: right model accepted, of {RIGHT}", taken / RIGHT, "1", 0.9, at_least=True))
        rows.append(Row(f"{name}: the same, upper end of its 95 % interval", interval.high, "1", 0.95, at_least=True))
        rows.append(Row(f"{name}: the same, lower end", interval.low, "1"))
        with_strain = [c for c in found if c.strain is not None]
        accepted = float(np.mean([c.accepted for c in with_strain]))
        rows.append(Row(f"{name}: right model accepted with strain too, of {len(with_strain)}", accepted, "1"))
        sigma = float(np.mean([c.factor_sigma for c in found]))
        rows.append(Row(f"{name}: standard uncertainty of the factor", sigma, "1"))
        z = [(c.factor - 1.0) / c.factor_sigma for c in found]
        rows.append(Row(f"{name}: factor's error over it, rms", float(np.sqrt(np.mean(np.square(z)))), "1", 1.2))
        chi = [c.displacement.overall.chi_square / c.displacement.overall.degrees for c in found]
        rows.append(Row(f"{name}: chi-square over its degrees of freedom, mean", float(np.mean(chi)), "1"))
        off = [_compared(one, wrong, rng, strain=False) for _ in range(WRONG)]
        refuted = float(np.mean([not c.accepted for c in off]))
        rows.append(Row(f"{name}: stiffness wrong by 2 % refuted, of {WRONG}", refuted, "1", 0.95, at_least=True))
        shown.append((name, [c.displacement.overall.probability for c in found], off[0]))
    _draw(shown, figures / "accuracy_models.png")
    return Section(
        "Comparison with a model",
        f"Displacements by formula, seen through {SUBSET_PX} px subsets (mean of 15 x 15 samples), {SHAPE[0]} x {SHAPE[1]} points, "
        "with drawn noise: 0.42, 0.42 and 1.4 um of U, V, W at each point, white pixels shared by overlapping subsets, and four "
        "unit causes of a common factor. The clamped plate is Eq. (18) at half pressure; the plate with a hole is Kirsch's, "
        f"2 mm radius under {STRESS_MPA:g} MPa. The models are meshes of these formulas.",
        rows,
        [
            (
                "accuracy_models.png",
                "Probabilities of right models over their rank, and z of a model that is 2 % too stiff",
            )
        ],
        [
            "A stiffness wrong by 2 % is 2 % of the displacement: it is refuted where that is more than some 4 of the factor's "
            "standard uncertainties, as in both cases here. With more noise, fewer points or less load the factor's uncertainty, "
            "which every comparison states, says what can be told."
        ],
    )


def _draw(shown: list[tuple[str, list[float], ModelComparison]], path: Path) -> None:
    fig, axes = plt.subplots(1, 3, figsize=(11.0, 3.6))
    for name, p, _ in shown:
        axes[0].plot((np.arange(len(p)) + 0.5) / len(p), np.sort(p), ".-", label=name)
    axes[0].plot([0, 1], [0, 1], "k-", lw=0.8)
    axes[0].set(xlabel="rank", ylabel="probability of the right model")
    axes[0].legend()
    for ax, (name, _, found), component in zip(axes[1:], shown, (2, 0), strict=True):
        image = ax.imshow(found.displacement.z[..., component], cmap="RdBu_r", vmin=-4, vmax=4)
        ax.set(title=f"{name}: z of {'uvw'[component]}", xticks=[], yticks=[])
        fig.colorbar(image, ax=ax)
    fig.tight_layout()
    fig.savefig(path, dpi=110)
    plt.close(fig)


SECTIONS: dict[str, Callable[[Path], Section]] = {"models": models}
