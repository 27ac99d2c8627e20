"""The other half of test_fuzz.py: generated requests, right and wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fuzz_verdict import IN_CI, judge


@pytest.mark.timeout(2400)
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@pytest.mark.fault(51)
@pytest.mark.fault(52)
def test_generated_requests(tmp_path: Path) -> None:
    each, least = (250, 12_500) if IN_CI else (20, 1_000)
    judge(tmp_path, phases=("fuzzing",), each=each, seed=20261123, least=least)
