"""The README's scripts are run as they stand there, against a served rig, and what they measure is the truth."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from server.demo.process import running_service
from tests.support.requirements import ROOT
from tests.support.service_rig import true_cameras, wait_for_rig

pytestmark = pytest.mark.timeout(400)
API = "/api/v1"
RIG = ROOT / "config" / "sim_paper.toml"
WRITTEN = "http://127.0.0.1:8000"
# what the scripts say of the plate: the paper's, in mm and N/mm^2, and the last pressure in kPa
RADIUS, THICKNESS, MODULUS, POISSON, PRESSURE = 13.385, 0.762, 71.0e3, 0.334, 689.0


def script(language: str, like: str) -> str:
    """Return the README's one block in a language that has this in it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = [block for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL) if like in block]
    assert len(found) == 1, f"{len(found)} blocks in {language} with {like}"
    assert WRITTEN in found[0]
    assert len([line for line in found[0].splitlines() if line.strip()]) <= 10
    return str(found[0])


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service of its own process, with a calibration: the simulated cameras' own parameters."""
    folder = tmp_path_factory.mktemp("readme")
    with (
        running_service(RIG, folder / "data", folder / "service.log") as url,
        httpx.Client(base_url=url, timeout=60.0, trust_env=False) as made,
    ):
        wait_for_rig(made)
        cameras = json.dumps(true_cameras(RIG.read_text(encoding="utf-8")))
        sent = made.post(f"{API}/calibrations:import", files={"file": ("true.json", cameras)})
        assert sent.status_code == 201, sent.text
        yield made


def is_the_plate(client: httpx.Client, w_mm: Any) -> None:
    """Assert that this is W of the newest analysis, and the textbook's: a clamped plate's deflection."""
    test_id = client.get(f"{API}/tests").json()["tests"][-1]["id"]
    test = client.get(f"{API}/tests/{test_id}").json()
    assert [step["label"] for step in test["steps"]] == ["0 kPa", "344.5 kPa", "689 kPa"]
    path = f"{API}/tests/{test_id}/analyses/{test['analyses'][-1]['id']}/steps/2/fields"
    x, y, told = (
        np.array(client.get(f"{path}/{name}").json()["values"], dtype=float) for name in ("x_mm", "y_mm", "w_mm")
    )
    np.testing.assert_allclose(w_mm, told.reshape(np.shape(w_mm)), rtol=1e-6)
    stiffness = MODULUS * THICKNESS**3 / (12 * (1 - POISSON**2))
    deflection = PRESSURE * 1e-3 * RADIUS**4 / (64 * stiffness)
    true = -deflection * np.clip(1 - (np.hypot(x, y) / RADIUS) ** 2, 0, None) ** 2
    assert np.isfinite(told).mean() > 0.99
    assert np.abs(told).max() > 0.1
    assert np.sqrt(np.nanmean((told - true) ** 2)) < 1e-3  # mm


def test_ten_lines_of_curl(client: httpx.Client, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl not found: apt install curl to run the README's script")
    text = script("sh", "curl").replace(WRITTEN, str(client.base_url).rstrip("/"))
    done = subprocess.run(["bash", "-euc", text], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "w.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    is_the_plate(client, [float(row["w_mm"] or "nan") for row in rows])


def test_ten_lines_of_python(client: httpx.Client, tmp_path: Path) -> None:
    text = script("python", "httpx").replace(WRITTEN, str(client.base_url).rstrip("/"))
    (tmp_path / "script.py").write_text(
        f"{text}\nimport json\njson.dump(w_mm, open('w.json', 'w'))\n", encoding="utf-8"
    )
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    is_the_plate(client, np.array(json.loads((tmp_path / "w.json").read_text(encoding="utf-8")), dtype=float))
