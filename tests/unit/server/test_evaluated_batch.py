"""Several measurements by one recipe: the command over a table, and what is said over specimens."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.cli.main import main
from stereorig.server.evaluations.specimens import factor, over_specimens
from stereorig.server.evaluations.tensile.document import CardNumber, CurveFound, MaterialCardFound
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.gauge_field import SUBSET, make_field

E_MPA = 20_000.0
STATED = {"width_mm": 10.0, "section_u": 0.002, "load_scale_u": 0.002, "load_u_n": 1.0, "direction": "rows"}


def specimen(folder: Path, modulus: float, area_mm2: float) -> None:
    """Results of a strip that is pulled along the rows in 24 steps, with its load."""
    folder.mkdir()
    for n in range(24):
        strain = 0.0004 * n
        field = make_field(None if n == 0 else lambda x, e=strain: x * [1.0 + e, 1.0 - 0.3 * e, 1.0])
        found = None if n == 0 else surface_strain(field, StrainOptions(), subset_px=SUBSET)
        extra = {"load_n": f"{modulus * area_mm2 * strain}"}
        write_field(
            folder / f"step_{n:04d}.nc", field, Provenance({"subset_px": SUBSET}, {}, "1", step=n, extra=extra), found
        )


def test_a_table_of_specimens_gives_a_card_each_and_the_material(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moduli = [0.98 * E_MPA, E_MPA, 1.02 * E_MPA]
    lines = ["folder,name,thickness_mm"]
    for k, modulus in enumerate(moduli):
        specimen(tmp_path / f"r{k}", modulus, 10.0 * (2.0 + 0.1 * k))
        lines.append(f"r{k},s{k},{2.0 + 0.1 * k}")
    (tmp_path / "gone").mkdir()
    (tmp_path / "batch.csv").write_text("\n".join([*lines, "gone,s9,2"]))
    given = [part for name, value in STATED.items() for part in ("--set", f"{name}={value}")]
    out = tmp_path / "out"
    assert main(["evaluate", "tensile", str(tmp_path / "batch.csv"), *given, "--out", str(out), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["refused"]["s9"]["code"] == "results_missing"
    of_all = found["all"]["numbers"]["E"]
    # the surface is tilted against the pull, and strain is along the surface's plane: some per cent of the stretch
    assert [found["each"][f"s{k}"]["numbers"]["E"]["value"] for k in range(3)] == pytest.approx(moduli, rel=0.03)
    assert of_all["count"] == 3
    assert of_all["s"] == pytest.approx(0.02 * E_MPA, rel=0.05)
    assert of_all["k"] == pytest.approx(6.155, abs=0.002)  # the handbooks' table: 3 specimens, 90 %, 95 % sure
    assert json.loads((out / "tensile_all.json").read_text()) == found["all"]
    assert (out / "s1" / "tensile.html").exists()
    assert (out / "tensile_all.csv").read_text().startswith("symbol,units,count")


@pytest.mark.parametrize(
    "text", ["", "folder\n", "name\na\n", "folder,name\na,x\nb,x\n", "folder,name\na,../x\n"], ids=range(5)
)
def test_a_table_that_is_none_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "b.csv").write_text(text)
    assert main(["evaluate", "tensile", str(tmp_path / "b.csv")]) != 0
    assert "batch_invalid" in capsys.readouterr().err


@pytest.mark.parametrize(("count", "k"), [(5, 3.407), (10, 2.355), (20, 1.926)])
def test_the_factor_is_the_handbooks(count: int, k: float) -> None:
    """One-sided factors of a normal distribution for 90 % of it, 95 % sure, as tables print them."""
    assert factor(count) == pytest.approx(k, abs=6e-4)


def test_what_all_specimens_share_is_not_averaged_away() -> None:
    def card(value: float) -> MaterialCardFound:
        number = CardNumber(
            key="modulus", value=value, units="MPa", u=5.0, state="good", parts={"load_scale": 3.0, "strain": 4.0}
        )
        lists = {name: [] for name in CurveFound.model_fields}
        return MaterialCardFound(
            verdict="good",
            accepted=True,
            standard="ISO 6892-1",
            section_mm2=1.0,
            numbers={"E": number},
            toe_strain=0.0,
            window_steps=[],
            marks=[],
            not_included=[],
            curve=CurveFound.model_validate(lists),
        )

    values = np.array([98.0, 102.0, 100.0, 104.0])
    found = over_specimens({str(k): card(value) for k, value in enumerate(values)}).numbers["E"]
    assert found.u == pytest.approx(np.hypot(values.std(ddof=1) / 2.0, 3.0))
