"""Defocus in time: the true error over the reported standard deviation where both cameras are blurred at t."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from stereorig.core.settings import PATCH_SETTINGS, PatchSetting
from tests.bench.accuracy.table import Row, Section
from tests.support.blurred_in_time import Beside, BlurredPlate
from tests.support.relief_rig import Texture

TEXTURES = {
    "soft speckle of 6 px": Texture(0.6, 1, 1.6),
    "black and white speckle of 4 px": Texture(0.4, 4, 3.0),
    "coarse speckle of 11 px": Texture(1.1, 2, 1.6),
    "sharp discs": Texture(0.45, 5, balls=True),
}
SUBSETS_PX = (15, 21, 33)
BLURS_PX = (0.0, 0.5, 1.0, 1.5, 2.0)
NOISY, OTHER_PATCHES = ("soft speckle of 6 px", "sharp discs"), "soft speckle of 6 px"
LOWEST, HIGHEST = 0.9, 1.15
FEW = 0.02  # of the points: rejected

Key = tuple[str, int, float, float, PatchSetting]


def blur_in_time(figures: Path) -> Section:
    """Blur of 0.5 to 2 px at t, on four textures."""
    found: dict[Key, Beside] = {}
    for name, texture in TEXTURES.items():
        plate = BlurredPlate(texture)
        for blur in BLURS_PX:
            for subset in SUBSETS_PX:
                found[name, subset, 2.0, blur, "affine"] = plate.measured(blur, 2.0, subset)
            if name in NOISY:
                found[name, 21, 6.0, blur, "affine"] = plate.measured(blur, 6.0, 21)
            for patch in PATCH_SETTINGS:
                if name == OTHER_PATCHES and patch != "affine":
                    found[name, 33, 2.0, blur, patch] = plate.measured(blur, 2.0, 33, patch=patch)
    path = figures / "accuracy_blur_in_time.png"
    _draw(path, found)
    rows: list[Row] = []
    for blur in BLURS_PX:
        kept = [f for key, f in found.items() if key[3] == blur and f.valid > FEW]
        ratios = np.array([f.ratio for f in kept])
        over = _over_textures(found, blur)
        limits = (None, None) if blur == 0.0 else (LOWEST, HIGHEST)
        rows += [
            Row(
                f"blur {blur:g} px: true error over reported sigma, over the textures, least of {over.size}",
                float(over.min()),
                "",
                limits[0],
                at_least=True,
            ),
            Row(f"blur {blur:g} px: the same, largest", float(over.max()), "", limits[1]),
            Row(f"blur {blur:g} px: of one measurement, least of {ratios.size}", float(ratios.min()), ""),
            Row(f"blur {blur:g} px: of one measurement, largest", float(ratios.max()), ""),
            Row(
                f"blur {blur:g} px: measurements whose points are rejected, of {_count(found, blur)}",
                float(_count(found, blur) - len(kept)),
                "",
            ),
            Row(f"blur {blur:g} px: worst error of a valid point over its sigma", max(f.worst for f in kept), ""),
        ]
    return Section(
        "Defocus in time",
        "A tilted plate, turned, strained and moved; the pictures at t of both cameras are blurred by a Gaussian before "
        "their noise. Four textures, subsets of 15, 21 and 33 px, noise 2, and 6 on two textures; every kind of patch on one; "
        "u, v and w; rms over some 2,700 points, of which those of 33 px hold no more than 250 subsets apart: one "
        "measurement's ratio scatters by 5 % (21 px: 3 %), so that the figures asked are those over the textures, by subset. "
        "Pictures by a renderer that shares nothing with the program.",
        rows,
        [(path.name, "True error over reported sigma, plane patches")],
        ["Points whose standard deviation exceeds `max_sigma_px` are rejected: all of them at 2 px in small subsets."],
    )


def _over_textures(found: dict[Key, Beside], blur: float) -> NDArray[np.float64]:
    """Ratios of u, v, w by subset, rms over the measurements of noise 2 and plane patches that have points."""
    ratios = []
    for subset in SUBSETS_PX:
        each = [found[name, subset, 2.0, blur, "affine"] for name in TEXTURES]
        kept = [f.ratio**2 for f in each if f.valid > FEW]
        if kept:
            ratios.append(np.sqrt(np.mean(kept, axis=0)))
    return np.array(ratios)


def _count(found: dict[Key, Beside], blur: float) -> int:
    return sum(key[3] == blur for key in found)


def _draw(path: Path, found: dict[Key, Beside]) -> None:
    fig, axes = plt.subplots(1, len(SUBSETS_PX), figsize=(11, 3.2), layout="constrained", sharey=True)
    for ax, subset in zip(axes, SUBSETS_PX, strict=True):
        for name, colour in zip(TEXTURES, ("C0", "C1", "C2", "C3"), strict=True):
            each = [found[name, subset, 2.0, blur, "affine"] for blur in BLURS_PX]
            ratio = np.array([f.ratio if f.valid > FEW else np.full(3, np.nan) for f in each])
            for k, style in enumerate(("-", "--", ":")):
                ax.plot(BLURS_PX, ratio[:, k], style, color=colour, label=name if k == 0 else None)
        ax.axhspan(LOWEST, HIGHEST, color="0.9")
        ax.set_title(f"{subset} px")
        ax.set_xlabel("blur at t, px")
    axes[0].set_ylabel("true error over sigma: u, v (--), w (..)")
    axes[0].legend(fontsize=7)
    fig.savefig(path, dpi=110)
    plt.close(fig)


SECTIONS = {"blur-in-time": blur_in_time}
