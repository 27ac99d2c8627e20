"""Differences of gauges between steps: what both steps share cancels, beside draws of every error by its own."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.server.cli.main import main
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.gauge_field import SUBSET, make_field

INPUTS = {"calibration": "aa", "reference_cam1": "bb", "reference_cam2": "cc"}
#: row and column of the gauges' ends, whose subsets share no pixel
AT = ((2, 2), (2, 12))
FROZEN = 0.6
DRAWS = 4000


def step_field(n: int) -> Field:
    """A stretched field with a common factor, much as displacements have it, and noise that is frozen in part."""
    field = make_field(lambda x: x @ np.diag([1.0 + 0.01 * n, 1.0, 1.0]).T + [0.3 * n, 0.0, 0.1])
    x, y = field.xyz_mm[..., 0], field.xyz_mm[..., 1]
    waves = np.stack([np.sin(0.3 * (k + 1) * x + 0.2 * k * y + k) for k in range(18)], axis=-1)
    common = 0.002 * waves.reshape(*field.shape, 6, 3)
    common[..., 3:, :] *= n  # grows with the displacement
    causes = Causes(("calibration", "calibration", "stage"), ("calibration", "stage"))
    return replace(field, common=common, causes=causes, frozen=FROZEN * field.covariance[..., 3:, 3:])


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("difference") / "results"
    folder.mkdir()
    for n, field in enumerate([make_field(None), step_field(1), step_field(3)]):
        about = Provenance({"subset_px": SUBSET}, INPUTS, "1", step=n)
        write_field(folder / f"step_{n:04d}.nc", field, about)
    return folder


def read(results: Path, tmp_path: Path, *more: str, suffix: str = ".json") -> Path:
    out = tmp_path / f"gauges{suffix}"
    gauges = ["--extensometer", "e=54,74,124,74", "--point", "p=54,74", "--area", "a=all"]
    assert main(["gauge", str(results), *gauges, *more, "--out", str(out)]) == 0
    return out


def drawn(rng: np.random.Generator) -> tuple[Any, Any]:
    """Elongations of the extensometer and u of its first end in both steps, DRAWS times, with all errors drawn."""
    fields = [step_field(1), step_field(3)]
    causes = rng.standard_normal((DRAWS, 3))
    both = []
    for place in AT:
        # the reference pair's noise: of X Y Z whole, of U V W in part, as one; new noise of U V W at each step
        C = fields[0].covariance[place]
        frozen = C.copy()
        frozen[3:, 3:] *= FROZEN
        new = (1.0 - FROZEN) * C[3:, 3:]
        shared = rng.multivariate_normal(np.zeros(6), frozen, DRAWS)
        ends = []
        for field in fields:
            assert field.common is not None
            assert field.uvw_mm is not None
            true = np.concatenate([field.xyz_mm[place], field.uvw_mm[place]])
            own = np.zeros((DRAWS, 6))
            own[:, 3:] = rng.multivariate_normal(np.zeros(3), new, DRAWS)
            ends.append(true + shared + own + causes @ field.common[place].T)
        both.append(ends)
    elongation = []
    for step in range(2):
        a, b = both[0][step], both[1][step]
        now = np.linalg.norm(b[:, :3] + b[:, 3:] - a[:, :3] - a[:, 3:], axis=1)
        elongation.append(now - np.linalg.norm(b[:, :3] - a[:, :3], axis=1))
    return elongation, [both[0][step][:, 3] for step in range(2)]


def test_a_difference_of_two_steps_scatters_as_its_sigma_says(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads(read(results, tmp_path, "--difference-from", "1", "--k", "2").read_text())
    assert "extensometer e, less step 1" in capsys.readouterr().out
    base, step = document["steps"][1:]
    assert base["differences"] == []
    found = {one["gauge"]: one["values"] for one in step["differences"]}
    assert set(found) == {"p", "e", "a"}
    elongation, u = drawn(np.random.default_rng(20))
    for got, two, whole in (
        (
            found["e"]["elongation_mm"],
            elongation,
            [s["extensometers"][0]["values"]["elongation_mm"] for s in (base, step)],
        ),
        (found["p"]["u_mm"], u, [s["points"][0]["values"]["u_mm"] for s in (base, step)]),
    ):
        change = two[1] - two[0]
        assert got["value"] == pytest.approx(whole[1]["value"] - whole[0]["value"])
        assert got["value"] == pytest.approx(change.mean(), abs=5.0 * change.std() / np.sqrt(DRAWS))
        # 4,000 draws know a standard deviation to 1.1 %; files are in single precision
        assert got["sigma"] == pytest.approx(change.std(), rel=0.04)
        assert got["expanded"] == pytest.approx(2.0 * got["sigma"])
        assert sum(v**2 for v in got["budget"].values()) == pytest.approx(got["sigma"] ** 2)
        assert got["budget"]["reference"] == 0.0
        # as if the steps shared nothing it would be more
        assert got["sigma"] < 0.8 * np.hypot(whole[0]["sigma"], whole[1]["sigma"])
    assert set(found["p"]) == {"u_mm", "v_mm", "w_mm"}  # positions are the reference's in all steps
    assert found["a"]["u_mm"]["budget"]["stage"] > 0.0


def test_differences_stand_in_the_table_beside_what_they_are_made_of(results: Path, tmp_path: Path) -> None:
    out = read(results, tmp_path, "--difference-from", "1", "--step", "2", suffix=".csv")
    lines = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    rows = {(r["kind"], r["quantity"]): r for r in csv.DictReader(lines)}
    assert {r["step"] for r in rows.values()} == {"2"}
    row = rows["extensometer", "elongation_mm:since_step_1"]
    assert float(row["sigma"]) > 0.0
    assert float(row["u_reference"]) == 0.0


def test_a_difference_from_the_reference_is_refused(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for base, code in ((0, "gauge_unusable"), (7, "step_missing")):
        rc = main(["gauge", str(results), "--point", "54,74", "--difference-from", str(base)])
        assert rc != 0
        assert code in capsys.readouterr().err
