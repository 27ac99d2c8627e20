"""The evaluations' cards: how often their 95 % intervals hold the truth."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from tests.accuracy.test_crack_card import covered as covered_cracks
from tests.accuracy.test_material_card import covered as covered_tests
from tests.bench.accuracy.table import Row, Section
from tests.support.strip_images import TRUTH, cards, within

TESTS, CRACKS, RENDERED = 250, 100, 100


def evaluations(_: Path) -> Section:
    """Measure every figure of the section."""
    share = "%"
    tests = covered_tests(TESTS)
    rows = [
        Row(f"{law}: {key} within its 95 % interval", 100.0 * held, share) for (law, key), held in sorted(tests.items())
    ]
    rows.append(
        Row("tensile tests, all laws and numbers: within 95 %", 100.0 * float(np.mean(list(tests.values()))), share)
    )
    with tempfile.TemporaryDirectory() as folder:
        found = list(cards(Path(folder), RENDERED, seed=2))
    rows += [
        Row(f"rendered strip: {symbol} within its 95 % interval", 100.0 * within(found, symbol), share)
        for symbol in TRUTH
    ]
    cracks = {key: np.mean(np.abs(errors) <= 1.96) for key, errors in covered_cracks(CRACKS).items()}
    rows += [Row(f"crack: {key} within its 95 % interval", 100.0 * float(held), share) for key, held in cracks.items()]
    rows.append(Row("cracks, all numbers: within 95 %", 100.0 * float(np.mean(list(cracks.values()))), share))
    return Section(
        "Cards",
        f"{TESTS} tensile tests of each of four material laws at the level of gauges, {RENDERED} of a linear strip through "
        f"rendered images of 230 x 200 px; {CRACKS} fields of a crack in mixed mode, drawn from their covariance. A share of "
        "100 draws scatters by 2 points.",
        rows,
        [],
        [
            "Stated uncertainties of load and section are those that the draws have; the rendered strip's cameras are exact."
        ],
    )
