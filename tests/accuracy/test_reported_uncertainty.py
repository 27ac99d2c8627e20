"""Is the reported shape error the true one, and are stage and pitch found within what is told of them?"""

from __future__ import annotations

import numpy as np
import pytest

from tests.bench.accuracy.lenses_motions import Told, replicate
from tests.support.calibration_rigs import LENSES, rms

RUNS = 6


@pytest.mark.parametrize("lens", list(LENSES))
def test_the_reported_shape_error_is_the_true_one_whatever_the_lens(lens: str) -> None:
    runs = [replicate(lens, "cameras", seed) for seed in range(100, 100 + RUNS)]
    # some four modes make the error: the ratio over six runs scatters by 14 %; three of those
    assert rms([r.reported_um for r in runs]) / rms([r.true_um for r in runs]) == pytest.approx(1.0, abs=0.45)
    # asked of a lens that was 3.9 um off
    assert rms([r.true_um for r in runs]) < 0.5


@pytest.mark.parametrize("motion", ["cameras", "target"])
def test_stage_and_pitch_drawn_from_their_priors_are_found_within_their_uncertainty(motion: str) -> None:
    told = Told(scale_sigma=1e-3, step_sigma_mm=0.005, pitch_sigma=2e-4)
    runs = [replicate("pinhole", motion, seed, told, asked="paper") for seed in range(200, 200 + RUNS)]
    off = np.concatenate([r.covered for r in runs])
    # correlated figures of six draws: their rms scatters by some fifteen per cent
    assert rms(off.tolist()) == pytest.approx(1.0, abs=0.45)
    assert float(np.mean(np.abs(off) < 3.0)) > 0.95
