"""Schema fuzzing of the whole API over a running simulated rig: nothing undocumented, nothing that breaks it.

Two files share the cases, so that they run side by side; see test_fuzz_more.py. In depth they are 20,000 together;
``make fuzz`` runs on for longer.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fuzz_verdict import check_fuzz


@pytest.mark.deep
@pytest.mark.timeout(2400)
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@pytest.mark.fault(52)
@pytest.mark.fault(48)
def test_every_value_at_and_beyond_the_bounds(tmp_path: Path) -> None:
    check_fuzz(tmp_path, phases=("examples", "coverage", "stateful"), each=40, seed=20261122, min_cases=7000)
