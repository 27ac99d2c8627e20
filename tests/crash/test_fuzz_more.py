"""The other half of test_fuzz.py: generated requests, right and wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fuzz_verdict import check_fuzz


@pytest.mark.timeout(2400)
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@pytest.mark.fault(51)
@pytest.mark.fault(52)
@pytest.mark.parametrize(("each", "min_cases"), [(4, 200), pytest.param(130, 6_500, marks=pytest.mark.deep)])
def test_generated_requests(tmp_path: Path, each: int, min_cases: int) -> None:
    check_fuzz(tmp_path, phases=("fuzzing",), each=each, seed=20261123, min_cases=min_cases)
