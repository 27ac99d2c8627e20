"""A tensile test on the simulated rig: captured, measured, and its material card over HTTP and by the command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, data_of, new_test, served, true_cameras, wait_for_job, wait_for_rig

API = "/api/v1"
E_MPA, POISSON, AREA_MM2 = 3000.0, 0.33, 40.0
STRAINS = np.concatenate([[0.0], np.linspace(0.0003, 0.0027, 9), [0.004, 0.006]])
SETTINGS = {
    "standard": "iso_527_2",
    "width_mm": 10.0,
    "thickness_mm": 4.0,
    "section_u": 0.002,
    "load_scale_u": 0.002,
    "load_u_n": 0.1,
}
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def served_test(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, str, Path]]:
    """A strip of a linear material, pulled in twelve steps; client, address of its analysis, folder of it."""
    data = data_of(tmp_path_factory.mktemp("card"))
    with Service(parse_config(SMALL), data) as own, served(own) as client:
        wait_for_rig(client)
        sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(true_cameras(SMALL)))})
        test = new_test(client, name="strip", calibration_id=str(sent.json()["id"]))
        for strain in STRAINS:
            scene = {"scene": "strip", "load": 100.0 * float(strain)}
            client.put(f"{API}/sim/scene", json=scene).raise_for_status()
            step = {"label": f"{strain:g}", "load_n": float(E_MPA * AREA_MM2 * strain)}
            client.post(f"{API}/tests/{test}/steps", json=step).raise_for_status()
        body = {"region": {"rectangle": [50, 50, 205, 190]}, "subset_px": 21, "spacing_px": 8, "strain": {"window": 5}}
        begun = client.post(f"{API}/tests/{test}/analyses", json=body)
        assert begun.status_code == 202, begun.text
        wait_for_job(client, begun.json()["job"])
        analysis = begun.json()["analysis_id"]
        yield client, f"{API}/tests/{test}/analyses/{analysis}", data / "tests" / test / "analyses" / analysis


def test_the_card_has_the_material_and_is_the_commands(
    served_test: tuple[httpx.Client, str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    client, url, folder = served_test
    answer = client.post(f"{url}/evaluations/tensile", json={"settings": SETTINGS}, timeout=120.0)
    assert answer.status_code == 200, answer.text
    card = answer.json()["document"]
    for symbol, true in (("Et", E_MPA), ("mu", POISSON)):
        one = card["numbers"][symbol]
        assert one["state"] == "good", one
        # one draw: beyond four standard uncertainties lies one in 16,000
        assert abs(one["value"] - true) < 4.0 * one["u"], one
        assert one["u"] < 0.05 * true, one
    assert card["verdict"] == "good", card["marks"]
    assert card["numbers"]["sigma_m"]["why"].startswith("not_reached")
    assert set(card["numbers"]["Et"]["parts"]) >= {"strain", "section", "load_scale"}
    given = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    capsys.readouterr()
    assert main(["evaluate", "tensile", str(folder), *given, "--json", "--out", str(tmp_path / "card")]) == 0
    assert json.loads(capsys.readouterr().out) == card
    assert json.loads((tmp_path / "card" / "tensile.json").read_text()) == card
    assert (tmp_path / "card" / "tensile.csv").read_text().splitlines()[1].startswith("Et,")
    assert "<td>Et</td>" in (tmp_path / "card" / "tensile.html").read_text()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"section_u": None}, "section_missing"),
        ({"width_mm": None}, "section_missing"),
        ({"load_scale_u": None}, "load_uncertainty_missing"),
        ({"load_u_n": None}, "load_uncertainty_missing"),
        ({"load_channel": "crosshead"}, "load_missing"),
        ({"require": ["r"]}, "not_on_card"),
        ({"r_window": [0.2, 0.1]}, "evaluation_settings"),
    ],
)
def test_what_is_not_stated_is_refused_with_a_remedy(
    served_test: tuple[httpx.Client, str, Path], change: dict[str, Any], code: str
) -> None:
    client, url, _ = served_test
    answer = client.post(f"{url}/evaluations/tensile", json={"settings": SETTINGS | change}, timeout=120.0)
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert answer.json()["remedy"]


def test_too_few_steps_leave_the_card_incomplete_with_the_count(served_test: tuple[httpx.Client, str, Path]) -> None:
    client, url, _ = served_test
    settings = SETTINGS | {"min_steps": 50}
    card = client.post(f"{url}/evaluations/tensile", json={"settings": settings}, timeout=120.0).json()["document"]
    assert card["verdict"] == "incomplete"
    assert card["accepted"] is False
    assert card["numbers"]["Et"]["why"].startswith("too_few_steps: 7 steps")
