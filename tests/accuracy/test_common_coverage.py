"""The calibration's part covers what drawn calibrations do to a measurement; what is not declared is not covered."""

from __future__ import annotations

import numpy as np
import pytest

from tests.bench.accuracy.coverage import STRATA, Stratum, gathered

#: quantities that all points of a replicate share, so that replicates alone count
SHARED = ("length of 25 mm", "u of 2 mm", "v of 2 mm", "w of 2 mm", "X", "Y", "Z")


def check(stratum: Stratum, replicates: int) -> None:
    found = gathered(stratum, replicates)
    # the rms of n independent ratios scatters by 1 / sqrt(2 n); four of it, quantities being few
    slack = 4.0 / np.sqrt(2.0 * replicates)
    for name, (_, ratio) in found.items():
        assert 1.0 - slack < ratio < 1.0 + slack, (stratum.name, name, found)
    share = np.mean([found[name][0] for name in SHARED])
    # the mean share of seven quantities, which partly share their errors: sd of 0.95 over n replicates, three quarters
    assert share > 0.95 - 3.0 * 0.75 * np.sqrt(0.95 * 0.05 / replicates), (stratum.name, found)


def test_a_drawn_calibration_is_covered() -> None:
    check(STRATA[2], 24)


@pytest.mark.deep
@pytest.mark.parametrize("stratum", STRATA, ids=lambda s: s.name)
def test_every_declared_error_is_covered(stratum: Stratum) -> None:
    check(stratum, 125)


def test_a_tilt_that_is_not_declared_is_not_covered() -> None:
    # a tolerance of the grid would count its stretch and shear, which hide such a tilt
    found = gathered(Stratum("tilt"), 12, declared=Stratum("none", tilt_sigma_rad=0.0))
    assert found["length of 25 mm"][0] < 0.9, found


def test_a_tolerance_that_is_not_declared_is_not_covered() -> None:
    found = gathered(Stratum("grid", 4e-3), 12, declared=Stratum("none"))
    # its residuals show, so that a part is taken for the localiser's noise; a length's error is still 1.5 times sigma
    assert found["length of 25 mm"][1] > 1.25, found
