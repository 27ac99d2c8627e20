"""The proof of coverage through the command line: a short form of it, and that its negative controls fail."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.bench.coverage.chain import run
from tests.bench.coverage.coverage import append, kept, replicate, wanted
from tests.bench.coverage.draw import drawn
from tests.bench.coverage.figures import TILTED, Kept, figures_of, read_figures, write_figures
from tests.bench.coverage.page import notes, rows
from tests.bench.coverage.pooled import WHITE, mean, pooled
from tests.bench.coverage.score import MEAN, OFF, SHAPE, scored
from tests.bench.coverage.strata import CONTROLS, MAIN, STRATA, Stratum

OF_4_UM = MAIN[2]
(TILT_OFF,) = CONTROLS


def nees(cells: dict[str, list[float]], motion: str, quantity: str) -> float:
    count, _, z2, _, _ = cells[f"{motion}|{quantity}"]
    return z2 / count


def test_a_drawn_grid_is_covered_from_its_pictures_to_a_displacement_and_not_without_its_part(tmp_path: Path) -> None:
    # the whole chain once, a motion only: what all points share is one draw, which is within three and a half sigma
    one = drawn(OF_4_UM, 1, only=("w of 2 mm",))
    cells = scored(one, run(one, tmp_path))
    for motion, quantities in ((SHAPE, "XYZ"), ("w of 2 mm", "uvw")):
        for quantity in quantities:
            assert nees(cells, motion, quantity) < 3.5**2, (quantity, cells)
    off = [nees(cells, f"{OFF}: {motion}", q) for motion, q in ((SHAPE, "X"), (SHAPE, "Y"), ("w of 2 mm", "w"))]
    # of a grid of 4 um the calibration's part is several times the matching's
    assert max(off) > 3.5**2, cells


def test_a_run_that_was_killed_goes_on_where_it_was(tmp_path: Path) -> None:
    two = MAIN[:2]
    todo = list(wanted(two, 3, 2, tmp_path))
    assert todo == [(s, k) for k in range(3) for s in two]
    append(two[0], {"seed": 1, "cells": {}}, tmp_path)
    path = next(tmp_path.iterdir())
    path.write_text(path.read_text() + '{"seed": 2, "ce')  # killed while it wrote
    assert [entry["seed"] for entry in kept(two[0], tmp_path)] == [1]
    append(two[0], {"seed": 0, "cells": {}}, tmp_path)
    assert [entry["seed"] for entry in kept(two[0], tmp_path)] == [1, 0]
    assert list(wanted(two, 3, 2, tmp_path)) == [(two[1], 0), (two[1], 1), (two[0], 2), (two[1], 2)]


def test_strata_have_one_file_each(tmp_path: Path) -> None:
    for stratum in STRATA:
        append(stratum, {"seed": 0}, tmp_path)
    assert len(list(tmp_path.iterdir())) == len(STRATA)


def test_cells_are_pooled_over_replicates() -> None:
    entries: list[dict[str, Any]] = [
        {"seed": k, "cells": {"shape|X": [4, within, z2, 2.0, 8.0], f"{OFF}: shape|X": [4, 0, 99.0, 2.0, 1.0]}}
        for k, (within, z2) in enumerate(((4, 2.0), (2, 6.0)))
    ]
    pool = pooled(OF_4_UM, [*entries, {"seed": 9, "refused": "calibrate ended with 1"}])
    (cell,) = pool.cells
    assert (pool.replicates, pool.refused) == (2, 1)
    assert (cell.coverage, cell.nees, cell.sharpness) == (0.75, 1.0, 2.0)
    # between replicates 1 and 0.5: their standard error
    assert pool.coverage("shape") == pytest.approx((0.75, 0.25))
    assert pooled(OF_4_UM, entries, control=OFF).cells[0].coverage == 0.0


def test_a_stratum_drawn_anew_takes_the_place_of_its_kept_figures_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    one, two = MAIN[:2]
    older = {"shape|X": [100, 90, 110.0, 2.0, 8.0], "w of 2 mm|w": [100, 92, 120.0, 1.0, 1.0]}
    newer = {"shape|X": [100, 97, 90.0, 2.0, 8.0], "w of 2 mm|w": [100, 99, 80.0, 1.0, 1.0]}
    entries = [{"seed": k, "cells": older, "reasons": [], "warnings": []} for k in range(2)]
    write_figures(
        Kept({s.name: figures_of(s, entries, "2026-01-01") for s in (one, two)}, {"2026-01-01": (1, 4)}), path
    )
    shown = read_figures(path)
    again = tmp_path / "again.json"
    write_figures(shown, again)
    assert again.read_text() == path.read_text()
    shown.strata[two.name] = figures_of(two, [{"seed": 0, "cells": newer, "reasons": []}], "2026-02-02")
    found = {what: value for what, value, *_ in rows(shown)}
    # by motion: 90 % of the kept one with the scatter of two equal replicates, 97 % of the new one without any
    of = {s.name: [v for what, v in found.items() if what.startswith(f"{s.name}: shape, ")] for s in (one, two)}
    assert of == {one.name: ["90.0", "0.0", "1.10"], two.name: ["97.0", "0.90"]}
    assert [found[f"{s.name}: all motions, w, squared error over variance"] for s in (one, two)] == ["1.20", "0.80"]
    assert [line for line in notes(shown) if line.startswith("Drawn on")] == [
        f"Drawn on 2026-01-01, with the program of that day: {one.name}.",
        f"Drawn on 2026-02-02, with the program of that day: {two.name}.",
    ]


#: the same pictures under the same seed: a negative control scores the replicates of the main strata anew
kept_replicate = functools.cache(replicate)


def cells_of(stratum: Stratum, seeds: Sequence[int]) -> list[dict[str, Any]]:
    entries = [kept_replicate(stratum, seed) for seed in seeds]
    assert all("cells" in entry for entry in entries), entries
    return entries


@pytest.mark.deep
@pytest.mark.parametrize("stratum", MAIN, ids=lambda s: s.name)
def test_a_few_replicates_of_each_main_stratum_are_covered(stratum: Stratum) -> None:
    pool = pooled(stratum, cells_of(stratum, range(1000, 1006)))
    # six draws of what all points share: their mean share scatters by some 3 %, and four times that is asked
    share, _ = pool.coverage()
    assert share > 0.83, pool
    squared = mean(pool.of(), lambda c: c.nees)
    assert 0.5 < squared < 2.0, pool


@pytest.mark.deep
def test_without_the_calibrations_part_a_grid_of_4_um_is_not_covered() -> None:
    off = pooled(OF_4_UM, cells_of(OF_4_UM, range(1000, 1004)), control=OFF)
    for quantity in ("X", "length"):
        assert mean(off.of(SHAPE, quantity), lambda c: c.coverage) < 0.6, off


@pytest.mark.deep
def test_without_the_prior_of_the_tilt_a_tilted_axis_is_not_covered() -> None:
    pool = pooled(TILT_OFF, cells_of(TILT_OFF, range(1000, 1004)))
    shown = [c for motion, quantity in TILTED for c in pool.of(motion, quantity)]
    assert mean(shown, lambda c: c.coverage) < 0.75, pool


@pytest.mark.deep
def test_frozen_noise_of_the_reference_that_is_declared_white_is_not_covered() -> None:
    entries = cells_of(MAIN[0], range(1000, 1004))
    white, right = (pooled(MAIN[0], entries, control=c) for c in (WHITE, None))
    assert mean(white.of(MEAN), lambda c: c.coverage) < 0.85, white
    # some 500 point values of four draws of texture
    assert mean(right.of(MEAN), lambda c: c.coverage) > 0.9, right
