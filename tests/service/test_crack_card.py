"""The cracked panel on the simulated rig: captured, measured, and the crack's card over HTTP and by the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.rig import SimRig
from tests.support.requirements import ROOT
from tests.support.service_rig import data_of, new_test, served, true_cameras, wait_for_job, wait_for_rig

API = "/api/v1"
RIG = ROOT / "config" / "sim_panel.toml"
LOADS_KN = (0.0, 20.0, 30.0)
SHEET = CrackedPanel()
SETTINGS = {
    "youngs_modulus": 73.1,
    "modulus_unit": "GPa",
    "modulus_u": 0.01,
    "poisson": 0.33,
    "poisson_u": 0.01,
    "panel": [SHEET.width_mm, SHEET.thickness_mm, 0.01],
}
pytestmark = pytest.mark.timeout(600)


def test_k_of_the_panel_rises_with_the_load_as_the_formula(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    panel, data = SHEET, data_of(tmp_path)
    along = np.linspace(-panel.half_crack_mm, panel.half_crack_mm, 21) * np.sqrt(0.5)  # it hangs upright
    xyz = np.stack([along, -along, np.full_like(along, -panel.bow_mm)], axis=-1)
    crack = SimRig.from_toml(RIG).cam1.camera.project(xyz).xy
    with Service(parse_config(RIG.read_text()), data) as own, served(own) as client:
        wait_for_rig(client)
        cameras = json.dumps(true_cameras(RIG.read_text()))
        sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", cameras)})
        test = new_test(client, name="panel", calibration_id=str(sent.json()["id"]))
        for load in LOADS_KN:
            client.put(f"{API}/sim/scene", json={"scene": "panel", "load": load}).raise_for_status()
            step = {"label": f"{load:g} kN", "load_n": 1e3 * load}
            client.post(f"{API}/tests/{test}/steps", json=step).raise_for_status()
        region = {"rectangle": [30, 30, 481, 449], "cracks": [crack.tolist()]}
        begun = client.post(f"{API}/tests/{test}/analyses", json={"region": region, "subset_px": 21, "spacing_px": 10})
        assert begun.status_code == 202, begun.text
        wait_for_job(client, begun.json()["job"])
        analysis = begun.json()["analysis_id"]
        url = f"{API}/tests/{test}/analyses/{analysis}/evaluations/crack"
        answer = client.post(url, json={"settings": SETTINGS}, timeout=120.0)
        refused = client.post(url, json={"settings": SETTINGS | {"modulus_unit": None}}, timeout=120.0)
    assert (refused.status_code, refused.json()["code"]) == (422, "modulus_unit_missing")
    assert answer.status_code == 200, answer.text
    card = answer.json()["document"]
    for one in card["steps"]:
        # the simulated field is that of a wide sheet: no width correction
        true = panel.stress_mpa(one["load_n"] / 1e3) * np.sqrt(np.pi * panel.half_crack_mm / 1e3)
        k = one["numbers"]["K_I"]
        # one draw: beyond four standard uncertainties is one in 16,000
        assert abs(k["value"] - true) < 4.0 * k["u"], (k, true)
        assert k["u"] < 0.04 * true
        # the formula takes the crack up to the tip that is found; the secant alone is 0.2 % above Tada's
        factor = np.sqrt(1.0 / np.cos(np.pi * panel.half_crack_mm / panel.width_mm))
        for symbol, formula in (("K_I, wide sheet", true), ("K_I, panel", factor * true)):
            stands = one["numbers"][symbol]
            of_length = np.hypot(stands["parts"]["tip"], stands["parts"]["other_end"])
            assert abs(stands["value"] - formula) < 4.0 * of_length + 0.0025 * formula, (stands, formula)
            assert of_length < 0.02 * formula
        assert abs(one["numbers"]["K_II"]["value"]) < 4.0 * one["numbers"]["K_II"]["u"]
        assert abs(one["numbers"]["J"]["value"] - 1e3 * true**2 / panel.youngs_modulus_mpa) < (
            4.0 * one["numbers"]["J"]["u"]
        )
    folder = data / "tests" / test / "analyses" / analysis
    given = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    capsys.readouterr()
    assert main(["evaluate", "crack", str(folder), *given, "--json", "--out", str(tmp_path / "card")]) in (0, 1)
    assert json.loads(capsys.readouterr().out) == card
    table = (tmp_path / "card" / "crack.csv").read_text().splitlines()
    assert table[1].split(",")[3] == "K_I"
    shown = (tmp_path / "card" / "crack.html").read_text()
    assert "<td>K_I</td>" in shown
    assert "<td>30000 N: K_I, panel</td>" in shown
