"""The other half of test_fuzz.py: generated requests, right and wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fuzz_verdict import judge


@pytest.mark.timeout(2400)
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@pytest.mark.fault(51)
@pytest.mark.fault(52)
@pytest.mark.parametrize(("each", "least"), [(8, 400), pytest.param(250, 12_500, marks=pytest.mark.deep)])
def test_generated_requests(tmp_path: Path, each: int, least: int) -> None:
    judge(tmp_path, phases=("fuzzing",), each=each, seed=20261123, least=least)
