"""Every command of the tutorial is run as it is printed, against a served rig, and what it measures is the truth."""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from stereorig.server.demo.process import running_service
from tests.support.document_scripts import WRITTEN, blocks, one_block, run
from tests.support.plate_truth import check_plate_field
from tests.support.requirements import ROOT
from tests.support.service_rig import true_cameras, wait_for_rig

pytestmark = pytest.mark.timeout(400)
API = "/api/v1"
NO_CURL = "curl not found: apt install curl to run the tutorial's scripts"
RIG = ROOT / "config" / "sim_paper.toml"
SCRIPT, FILES, LIBRARY = "docs/tutorial/script.md", "docs/tutorial/files.md", "docs/tutorial/library.md"


def script(language: str, like: str) -> str:
    """Return the tutorial's one block in a language that has this in it: ten lines at most."""
    found = one_block(SCRIPT, language, like)
    assert WRITTEN in found
    assert len([line for line in found.splitlines() if line.strip()]) <= 10
    return found


def at(client: httpx.Client, text: str) -> str:
    """Return a script with the address of the service that runs here."""
    return text.replace(WRITTEN, str(client.base_url).rstrip("/"))


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service of its own process, with a calibration: the simulated cameras' own parameters.

    The newest calibration is another one, cancelled: nothing that the pages print may take it for the one in force.
    """
    folder = tmp_path_factory.mktemp("tutorial")
    with (
        running_service(RIG, folder / "data", folder / "service.log") as url,
        httpx.Client(base_url=url, timeout=60.0, trust_env=False) as made,
    ):
        wait_for_rig(made)
        cameras = json.dumps(true_cameras(RIG.read_text(encoding="utf-8")))
        sent = made.post(f"{API}/calibrations:import", files={"file": ("true.json", cameras)})
        assert sent.status_code == 201, sent.text
        accepted = made.put(f"{API}/calibrations/{sent.json()['id']}/review", json={"decision": "accepted"})
        assert accepted.status_code == 200, accepted.text
        begun = made.post(f"{API}/calibrations").json()["job"]["id"]
        assert made.post(f"{API}/jobs/{begun}:cancel", params={"wait": 30}).json()["state"] == "cancelled"
        yield made


def test_ten_lines_of_curl(client: httpx.Client, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip(NO_CURL)
    done = run(["bash", "-euc", at(client, script("sh", "curl"))], tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "w.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    check_plate_field(client, [float(row["w_mm"] or "nan") for row in rows])


def test_ten_lines_of_python(client: httpx.Client, tmp_path: Path) -> None:
    text = at(client, script("python", "httpx"))
    (tmp_path / "script.py").write_text(
        f"{text}\nimport json\njson.dump(w_mm, open('w.json', 'w'))\n", encoding="utf-8"
    )
    done = run([sys.executable, "script.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    check_plate_field(client, np.array(json.loads((tmp_path / "w.json").read_text(encoding="utf-8")), dtype=float))


def test_the_calibration_by_script(client: httpx.Client, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip(NO_CURL)
    before = len(client.get(f"{API}/calibrations").json()["calibrations"])
    done = run(["bash", "-euc", at(client, one_block(SCRIPT, "bash", "calibrations"))], tmp_path)
    assert done.returncode == 0, done.stderr
    made = client.get(f"{API}/calibrations").json()["calibrations"]
    assert len(made) == before + 1
    assert (made[-1]["verdict"]["level"], made[-1]["decision"]) == ("good", "accepted")
    assert re.search(r"^good$", done.stdout, re.MULTILINE)


def test_from_files(client: httpx.Client, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip(NO_CURL)
    for block in blocks(FILES, "bash"):
        done = run(["bash", "-euc", at(client, block)], tmp_path)
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
    (tmp_path / "read.py").write_text(one_block(FILES, "python", "netCDF4"), encoding="utf-8")
    done = run([sys.executable, "read.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(-0.117, abs=0.001)  # mm, as the page states
    assert json.loads((tmp_path / "calibration.json").read_text())["verdict"]["level"] == "good"
    with (tmp_path / "gauges.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    strain = [
        float(r["value"]) for r in rows if r["gauge"] == "across" and r["quantity"] == "strain" and r["step"] == "2"
    ]
    assert strain == [pytest.approx(0.00084, abs=0.00005)]
    assert list((tmp_path / "maps").glob("*exx.png"))
    assert (tmp_path / "paraview" / "result.pvd").exists()
    # the library's page goes on in the same folder
    text = one_block(LIBRARY, "python", "import stereorig")
    assert len([line for line in text.splitlines() if line.strip()]) <= 15
    (tmp_path / "library.py").write_text(text, encoding="utf-8")
    done = run([sys.executable, "library.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    valid, points, w_mm, sigma_um = (
        float(v) for v in re.findall(r"(\d+) of (\d+) points, W from (\S+) mm, .* (\S+) um", done.stdout)[0]
    )
    assert valid > 0.98 * points
    assert w_mm == pytest.approx(-0.117, abs=0.001)
    assert 0.05 < sigma_um < 1.0
    assert (tmp_path / "w.png").stat().st_size > 5000
