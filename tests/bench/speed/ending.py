"""What it costs that a fit ends its iterations early: random error over its bound, bias and lost points against full iteration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.matching import MatchOptions, fit_motion, prepare
from stereorig.core.settings import Interpolation
from tests.bench.accuracy.noise import SHIFT_PX, Sample
from tests.bench.accuracy.noise_bound import bound, displacement_bound
from tests.bench.accuracy.noise_scenes import Window, digitise
from tests.bench.accuracy.table import Row
from tests.bench.speed.kernel import NEAR, Fitted, shifted

NOISE = 2.0
FULL_PX = 1e-6  # what full iteration may leave unmade
HOW = """A fit stops where little is left to move, and mostly after one step from the step before. What that costs is in the table of targets: motions
from starts some 0.05 px away on {repeats} sets of images of the paper's rig with noise 2 of 255, beside the same fits iterated until 1e-6 px is left.
Accuracy defines [the bound](accuracy.md#random-error-and-its-bound); bias is the mean difference of the two, the worst of u, v and w."""


@dataclass(frozen=True)
class Ending:
    """A motion fit as it ends by itself, beside full iteration on the same images.

    Attributes
    ----------
    over_bound, full_over_bound
        Random error over the Cramer-Rao bound, rms over points and components.
    bias_px
        Mean difference from full iteration, the worst of u, v, w.
    lost
        Points that full iteration measures and the fit does not.
    """

    interpolation: Interpolation
    subset_px: int
    over_bound: float
    full_over_bound: float
    bias_px: float
    lost: int

    def rows(self) -> list[Row]:
        """Figures with their targets."""
        what = f"motion, {self.interpolation}, {self.subset_px} px, started as in a sequence"
        return [
            Row(f"{what}: random error over its bound", self.over_bound, "", 1.03),
            Row(f"{what}: the same, iterated in full", self.full_over_bound, ""),
            Row(f"{what}: bias against full iteration", self.bias_px, "px", 1e-3),
            Row(f"{what}: points lost against full iteration", self.lost, "", 0),
        ]


def measure_ending(interpolation: Interpolation, subset_px: int, repeats: int = 20, size_px: int = 330) -> Ending:
    """Fit a plane's motion on ``repeats`` noisy sets of images, from starts some 0.05 px away."""
    window = Window("paper", size_px=size_px)
    shift = window.shift_mm(*SHIFT_PX)
    clean = [*window.clean(), *window.clean(shift)]
    xy = window.points(subset_px)
    w, G = window.unknowns(xy, shift)
    least = displacement_bound(window, xy, w, G, bound(window, clean, xy, w, G, subset_px))
    least *= np.sqrt(NOISE**2 + 1.0 / 12.0)  # and of the rounding to whole grey levels
    options = MatchOptions(subset_px=subset_px, interpolation=interpolation)
    true, start = window.displacement(xy, w, G), shifted(Fitted(xy, w, G, options), NEAR)
    rng = np.random.default_rng(subset_px)
    errors: dict[str, list[np.ndarray]] = {"early": [], "full": []}
    for _ in range(repeats):
        images = [prepare(image, interpolation) for image in digitise(clean, NOISE, rng)]
        for name, chosen in (("early", options), ("full", replace(options, tolerance_px=FULL_PX))):
            fit = fit_motion(window.pair, *images, xy, *start, chosen)
            errors[name].append(
                np.where((fit.status == 0)[:, None], window.displacement(xy, fit.w, fit.G) - true, np.nan)
            )
    early, full = (np.array(errors[name]) for name in ("early", "full"))
    lost = int((np.isnan(early) & np.isfinite(full)).any(axis=2).sum())
    over, full_over = (Sample(e, np.empty(0), 0).over(least)[0] for e in (early, full))
    bias = np.abs(np.nanmean(early - full, axis=(0, 1))).max() / window.mm_per_px
    return Ending(interpolation, subset_px, over, full_over, float(bias), lost)
