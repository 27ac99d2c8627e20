"""Tails of distributions: the figures that scipy.stats gives, to the last bit, without loading it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import chi2, f, norm

from stereorig.core.robust import chi_square_tail, f_tail, two_sided_sigmas
from tests.support.requirements import ROOT

DEGREES = (1, 3, 6, 41.5, 2000.0)
STATISTICS = (-1.0, 0.0, 1e-9, 0.3, 1.0, 6.0, 55.0, 1e4, np.inf, np.nan)


@pytest.mark.parametrize("degrees", [0, -1.0, *DEGREES])
def test_the_tail_of_a_chi_square_is_scipys(degrees: float) -> None:
    for x in STATISTICS:
        np.testing.assert_array_equal(chi_square_tail(x, degrees), chi2.sf(x, degrees))


@pytest.mark.parametrize("degrees", [0, *DEGREES])
def test_the_tail_of_f_is_scipys(degrees: float) -> None:
    for x in STATISTICS:
        for left in (0.0, *DEGREES):
            np.testing.assert_array_equal(f_tail(x, degrees, left), f.sf(x, degrees, left))


def test_sigmas_of_a_probability_are_scipys() -> None:
    for p in (1.0, 0.5, 0.05, 1e-10, 1e-299):
        assert two_sided_sigmas(p) == norm.isf(p / 2.0)


def test_no_start_loads_scipys_statistics() -> None:
    # a third of a second of every start, of the service, of its compute process and of the command line
    names = ("api.app", "compute.tasks", "compute.measurement", "cli.measurement.image_pairs")
    modules = ", ".join(f"stereorig.server.{name}" for name in names)
    code = f"import sys, {modules}; print(sorted({{'scipy.stats', 'scipy.signal'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
